"""Where an inertial system begins: at rest, or in motion. While it cannot, it says what is missing, and by how much.

At rest, the accelerometer shows where up is and the gyroscope its bias. In motion, `alignment` finds gravity, velocity
and biases from what one or two seconds of images and samples say together; one camera needs to be accelerated for
that, two cameras or depth only to see. Derivation: docs/inertial.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_log
from lodelight.geometry.two_view import fit_two_view
from lodelight.imu.alignment import BEHIND, Alignment, Motions, Rows, align
from lodelight.imu.gyro_bias import gyro_bias
from lodelight.imu.preintegration import NavState, Preintegration, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.imu.units import accelerometer_fault, gyroscope_fault
from lodelight.rig import ImuSpec
from lodelight.types import AnyArray, Array

GRAVITY_M_S2 = 9.81
ALIGNED_VIEWS = 12
SIGN_CHI2 = 16.0  # by so much must the accelerometer's turned sign fit better
SIGN_SCALE = 0.25  # deviation of a scale of which it is known that it is not negative
BIAS_CHI2 = 16.27  # 99.9 % of three degrees of freedom


@dataclass(frozen=True)
class StartConfig:
    """rest_s : standing still for so long starts; longest_s : of images that are kept
    shortest_s : in motion, with one camera; shortest_metric_s : with two, or depth; shortest_tag_s : with a tag of
        known size in view
    rest_px, rest_gyro, rest_accel : standing still moves the image by no more (median), and deviates by no more,
        rad/s and m/s^2; a drone's motors may run
    min_tracks : landmarks seen from the first to the last image
    min_parallax_deg : of them, what one camera alone needs
    max_scale, max_tilt_deg, max_velocity : standard deviations above which it is too early; m/s
    max_px : what is left of the rays on average, above which images and IMU do not agree on one motion
    sigma_px : of a ray in the alignment. Several times a track's own: errors of one track are alike from frame to
        frame, and the IMU's own noise is not modelled there
    bias_gyro, bias_accel : deviations of the biases before anything is known, rad/s and m/s^2
    """

    rest_s: float = 0.4
    shortest_s: float = 1.4
    shortest_metric_s: float = 0.7
    shortest_tag_s: float = 0.1
    longest_s: float = 1.9
    rest_px: float = 0.75
    rest_gyro: float = 0.1
    rest_accel: float = 1.2
    min_tracks: int = 25
    min_parallax_deg: float = 1.0
    max_scale: float = 0.06
    max_tilt_deg: float = 2.0
    max_velocity: float = 0.15
    max_px: float = 0.8
    sigma_px: float = 1.3
    bias_gyro: float = 0.05
    bias_accel: float = 0.1


@dataclass(frozen=True, eq=False)
class StartView:
    """What one image saw: one row for each track and camera, sorted by nothing.

    track (N,), camera (N,); ray (N, 3) unit, in that camera; inv_depth, sigma_inv_depth (N,) 1/m, 0 = none
    R_now_last : (3, 3) turn of camera 0 since the image before, by the images alone
    tags : names of those of known size whose centres are among the rows, their distance as inverse depth
    """

    t_ns: int
    track: NDArray[np.int64]
    camera: AnyArray
    ray: Array
    inv_depth: Array
    sigma_inv_depth: Array
    R_now_last: Array
    tags: tuple[str, ...] = ()

    def first_camera(self) -> tuple[NDArray[np.int64], Array]:
        """Tracks and rays of camera 0."""
        own = self.camera == 0
        return self.track[own], self.ray[own]


@dataclass(frozen=True, eq=False)
class Started:
    """States of the body at images out of those that were kept, the last among them, in a frame whose z points up and
    whose origin is the first.

    how : "at rest" or "in motion"; why : in words, with figures
    sigma_tilt rad, sigma_velocity m/s, sigma_bias_gyro rad/s, sigma_bias_accel m/s^2 : of the first state
    sigma_scale : of how far the body went, as a share; tags : that were in view
    """

    how: str
    why: str
    states: list[NavState]
    sigma_tilt: float
    sigma_velocity: float
    sigma_bias_gyro: float
    sigma_bias_accel: float
    sigma_scale: float = 0.0
    tags: tuple[str, ...] = ()


class Starter:
    """Collects images with the samples between them until they suffice. T_body_cam : of every camera with rows."""

    def __init__(
        self, spec: ImuSpec, T_body_cam: Sequence[SE3], focal_px: float, metric: bool, config: StartConfig | None = None
    ) -> None:
        """metric : rows have depth, or a second camera"""
        self.config = config or StartConfig()
        self.spec = spec
        self.T_body_cam = list(T_body_cam)
        self.focal_px = focal_px
        self.metric = metric
        self.doubted = False  # images and IMU were found to contradict each other
        self.turns_fit = False  # a window has turned, and images and gyroscope agreed
        self._odd_ns: int | None = None  # the last image when a start first believed in a bias that is not likely
        self.views: list[StartView] = []
        self.imu: list[ImuSamples] = []  # imu[i] from views[i] to views[i + 1]

    def reset(self) -> None:
        self.views, self.imu, self._odd_ns = [], [], None

    def anew(self) -> Starter:
        """Another one, that has seen nothing."""
        return Starter(self.spec, self.T_body_cam, self.focal_px, self.metric, self.config)

    def add(self, view: StartView, imu: ImuSamples | None) -> None:
        """The next image, and the samples since the one before; without them (None) all before is forgotten, and so it
        is where an image shows nothing: neither rest nor turns can be told by it."""
        if imu is None or self._blank(view) or (self.views and self._blank(self.views[-1])):
            self.reset()
        elif self.views:
            self.imu.append(imu)
        self.views.append(view)
        while len(self.views) > 2 and self._span_s > self.config.longest_s:
            del self.views[0], self.imu[0]

    def _blank(self, view: StartView) -> bool:
        return len(view.first_camera()[0]) < self.config.min_tracks

    @property
    def _tags(self) -> tuple[str, ...]:
        """Of known size, in the newest image and the one before it."""
        return tuple(name for name in self.views[-1].tags if name in self.views[-2].tags) if len(self.views) > 1 else ()

    @property
    def _span_s(self) -> float:
        return (self.views[-1].t_ns - self.views[0].t_ns) * 1e-9 if self.views else 0.0

    def find(self) -> Started | str:
        """The start, or what is missing. Raises SourceError where the IMU's units are wrong."""
        c = self.config
        shortest_s = c.shortest_tag_s if self._tags else self._without_tags_s
        if self.views and self._blank(self.views[-1]):
            return f"{len(self.views[-1].first_camera()[0])} tracks in this image, {c.min_tracks} are needed"
        if len(self.views) < 3 or self._span_s < min(c.rest_s, shortest_s) - 1e-6:
            return (
                f"{self._span_s:.2f} s of images and IMU so far; {c.rest_s:.2f} s are needed standing still, "
                f"{shortest_s:.2f} s in motion"
            )
        fault = accelerometer_fault(np.vstack([s.accel for s in self.imu])) or self._gyro_fault()
        if fault:
            raise SourceError(fault)
        at_rest = self._at_rest() if self._span_s >= c.rest_s else f"standing still {c.rest_s:.2f} s are needed"
        if isinstance(at_rest, Started):
            return at_rest
        if self._span_s < shortest_s - 1e-6:
            return f"{at_rest}; in motion {shortest_s:.2f} s are needed, there are {self._span_s:.2f}"
        in_motion = self._in_motion(self._span_s >= self._without_tags_s)
        return in_motion if isinstance(in_motion, Started) else f"{at_rest}; {in_motion}"

    def in_motion(self) -> Started | str:
        """The start in motion or what is missing, for one who has started already. Raises SourceError where the
        accelerometer's sign is turned."""
        if self._span_s < self._without_tags_s:
            return "too short"
        return self._in_motion(True)

    @property
    def _without_tags_s(self) -> float:
        return self.config.shortest_metric_s if self.metric else self.config.shortest_s

    # -- at rest ------------------------------------------------------------------------------------------------

    def _at_rest(self) -> Started | str:
        c = self.config
        first = max(i for i, v in enumerate(self.views) if self.views[-1].t_ns - v.t_ns >= c.rest_s * 1e9)
        gyro = np.vstack([s.gyro for s in self.imu[first:]])
        accel = np.vstack([s.accel for s in self.imu[first:]])
        moved_px = self._moved_px(first)
        shakes = [
            (moved_px, c.rest_px, "the image moves by {:.1f} px, at rest {:.1f}"),
            (float(gyro.std(axis=0).max()), c.rest_gyro, "the gyroscope deviates by {:.3f} rad/s, at rest {:.3f}"),
            (
                float(accel.std(axis=0).max()),
                c.rest_accel,
                "the accelerometer deviates by {:.2f} m/s^2, at rest {:.2f}",
            ),
        ]
        for value, most, text in shakes:
            if value > most:
                return "in motion: " + text.format(value, most)
        bias = gyro.mean(axis=0)
        if np.linalg.norm(bias) > 0.5:
            return f"in motion: the gyroscope reads {np.linalg.norm(bias):.2f} rad/s, too much for a bias"
        up = accel.mean(axis=0)
        T = SE3(upright(-up), np.zeros(3))
        states = [NavState(v.t_ns, T, np.zeros(3), bias, np.zeros(3)) for v in self.views[first:]]
        n = len(gyro)
        tilt = math.hypot(c.bias_accel, float(accel.std(axis=0).max()) / math.sqrt(n)) / GRAVITY_M_S2
        why = f"at rest for {c.rest_s:.2f} s; gyroscope bias {np.linalg.norm(bias):.4f} rad/s"
        sigma_bias = max(float(gyro.std(axis=0).max()) / math.sqrt(n), 1e-3)
        return Started("at rest", why, states, tilt, 0.02, sigma_bias, c.bias_accel)

    def _moved_px(self, first: int) -> float:
        """Median displacement of camera 0's tracks since an image; a great deal where none is left."""
        track_a, ray_a = self.views[first].first_camera()
        track_b, ray_b = self.views[-1].first_camera()
        _, a, b = np.intersect1d(track_a, track_b, return_indices=True)
        if len(a) < self.config.min_tracks:
            return math.inf
        return float(np.median(np.linalg.norm(ray_a[a] - ray_b[b], axis=1))) * self.focal_px

    # -- in motion ----------------------------------------------------------------------------------------------

    def _in_motion(self, suspicious: bool) -> Started | str:
        """suspicious : raise SourceError where the accelerometer's sign seems to be turned"""
        c = self.config
        track_a, _ray_a = self.views[0].first_camera()
        track_b, _ = self.views[-1].first_camera()
        lasting = len(np.intersect1d(track_a, track_b))
        rows = self._rows()
        if lasting < c.min_tracks and len(rows.start) - 1 < 2 * c.min_tracks:
            return f"{lasting} tracks last for {self._span_s:.1f} s, {c.min_tracks} are needed"
        bias = self._gyro_bias()
        motions = self._motions(bias)
        parallax = math.inf if self.metric else self._parallax_deg(motions)
        if parallax < c.min_parallax_deg and not self._tags:
            return f"a parallax of {parallax:.2f} deg, {c.min_parallax_deg:.2f} are needed"
        sigma_ray = c.sigma_px / self.focal_px
        found = align(Motions.of(motions), rows, self.T_body_cam, sigma_ray, (0.2 * c.bias_gyro, c.bias_accel))
        if suspicious and parallax >= c.min_parallax_deg and (found == BEHIND or self.doubted):
            self._refuse_turned_sign(rows, sigma_ray, bias, found)
        if isinstance(found, str):
            return found
        missing = self._missing(found, motions) or self._unlikely(found)
        return missing or self._started(found, motions)

    def _unlikely(self, found: Alignment) -> str:
        """What speaks against a start that believes in a bias beyond all expectation: a body that leaves the ground,
        or that was pushed, shows what is neither motion nor bias. So later images are waited for; a bias that all of
        those show is one."""
        c, now_ns = self.config, self.views[-1].t_ns
        bias = float(np.linalg.norm(found.bias_accel))
        if bias**2 <= BIAS_CHI2 * c.bias_accel**2:
            return ""
        self._odd_ns = now_ns if self._odd_ns is None else self._odd_ns
        if self.views[0].t_ns > self._odd_ns:
            return ""
        while len(self.views) > 2 and self._span_s >= self._without_tags_s:
            del self.views[0], self.imu[0]
        return f"images and IMU would fit with a bias of {bias:.2f} m/s^2, {4.0 * c.bias_accel:.1f} at most are likely"

    @staticmethod
    def _sigma_scale(found: Alignment, motions: list[Preintegration]) -> float:
        return math.hypot(found.sigma_scale, _drift(found, motions))

    def _rows(self) -> Rows:
        """Sightings in the chosen images of the tracks that have four of them or more, three of few images and two of
        a tag's centre, sorted by track."""
        views = [self.views[i] for i in self._chosen]
        track = np.concatenate([v.track for v in views])
        frame = np.repeat(np.arange(len(views)), [len(v.track) for v in views])
        camera, ray, inv_depth, sigma = (
            np.concatenate([getattr(v, name) for v in views])
            for name in ("camera", "ray", "inv_depth", "sigma_inv_depth")
        )
        _, which, count = np.unique(track, return_inverse=True, return_counts=True)
        kept = np.flatnonzero((count[which] >= min(4, len(views))) | ((track < 0) & (count[which] >= 2)))
        order = kept[np.lexsort((camera[kept], frame[kept], track[kept]))]
        _, landmark = np.unique(track[order], return_inverse=True)
        return Rows(
            frame[order].astype(np.int32), camera[order].astype(np.int32), landmark.astype(np.int32),
            np.ascontiguousarray(ray[order]), inv_depth[order], sigma[order],
        )  # fmt: skip

    @property
    def _chosen(self) -> list[int]:
        """Images that the alignment is made of: neighbours tell little that is new, and take their time."""
        last = len(self.views) - 1
        return sorted({round(i) for i in np.linspace(0, last, min(ALIGNED_VIEWS, last + 1))})

    def _motions(self, bias: Array) -> list[Preintegration]:
        """From the first image to every other that was chosen."""
        out = [preintegrate(self.imu[0], bias, np.zeros(3), self.spec)]
        for samples in self.imu[1:]:
            out.append(out[-1].extended(samples))
        return [out[i - 1] for i in self._chosen[1:]]

    def _gyro_bias(self) -> Array:
        """From frame to frame first, then between frames farther apart, which tell it more sharply."""
        R = self.T_body_cam[0].R
        none = np.zeros(3)
        steps = [preintegrate(s, none, none, self.spec) for s in self.imu]
        bias, _ = gyro_bias(steps, [R @ v.R_now_last.T @ R.T for v in self.views[1:]])
        sigma_ray = 0.5 / self.focal_px
        for gap in (3, 6):
            motions, seen = [], []
            for i in range(0, len(self.views) - gap, 2):
                samples = self.imu[i]
                for later in self.imu[i + 1 : i + gap]:
                    samples = samples.joined(later)
                motion = preintegrate(samples, bias, none, self.spec)
                track_a, ray_a = self.views[i].first_camera()
                track_b, ray_b = self.views[i + gap].first_camera()
                _, a, b = np.intersect1d(track_a, track_b, return_indices=True)
                if len(a) < self.config.min_tracks:
                    continue
                believed = np.ascontiguousarray(R.T @ motion.dR.T @ R)
                turn, _, _, _ = fit_two_view(ray_a[a], ray_b[b], believed, 0.04 * motion.dt_s, sigma_ray, 3.0, 1)
                motions.append(motion)
                seen.append(R @ turn.T @ R.T)
            if len(motions) >= 2:
                bias, _ = gyro_bias(motions, seen)
        return bias

    def _gyro_fault(self) -> str:
        if self.turns_fit:
            return ""
        R = self.T_body_cam[0].R
        seen = np.stack([so3_log(np.ascontiguousarray(R @ v.R_now_last.T @ R.T)) for v in self.views[1:]])
        dt_s = [(s.t_ns[-1] - s.t_ns[0]) * 1e-9 for s in self.imu]
        turned = np.stack([np.trapezoid(s.gyro, (s.t_ns - s.t_ns[0]) * 1e-9, axis=0) for s in self.imu])
        return gyroscope_fault(turned, seen, float(np.sum(dt_s)))

    def _parallax_deg(self, motions: list[Preintegration]) -> float:
        """Median angle that translation moved the tracks by, from the first image to that where it is largest."""
        R = self.T_body_cam[0].R
        track_a, ray_a = self.views[0].first_camera()
        best = 0.0
        for view, motion in zip(self.views[1::3], motions[::3], strict=False):
            track_b, ray_b = view.first_camera()
            _, a, b = np.intersect1d(track_a, track_b, return_indices=True)
            if len(a) >= self.config.min_tracks:
                turned = ray_b[b] @ (R.T @ motion.dR @ R).T
                best = max(best, float(np.median(np.linalg.norm(np.cross(ray_a[a], turned), axis=1))))
        return math.degrees(best)

    def _misfit(self, found: Alignment) -> str:
        c = self.config
        if found.inliers < 0.6 * found.n:
            return f"{found.inliers} of {found.n} sightings agree with the IMU; check the camera's pose and the clocks"
        left_px = found.rms * c.sigma_px
        if left_px > c.max_px:
            return (
                f"images and IMU differ by {left_px:.2f} px, {c.max_px:.2f} at most; check the camera's pose and the "
                "clocks"
            )
        return ""

    def _missing(self, found: Alignment, motions: list[Preintegration]) -> str:
        c = self.config
        misfit = self._misfit(found)
        if misfit:
            return misfit
        shares = [
            (
                0.0 if self.metric or self._tags else self._sigma_scale(found, motions),
                c.max_scale,
                "scale known to {:.0%}, {:.0%} are needed: accelerate",
            ),
            (math.degrees(found.sigma_tilt), c.max_tilt_deg, "gravity known to {:.1f} deg, {:.1f} are needed: turn"),
            (found.sigma_velocity, c.max_velocity, "velocity known to {:.2f} m/s, {:.2f} are needed"),
        ]
        return next((text.format(value, most) for value, most, text in shares if not value < most), "")

    def _refuse_turned_sign(self, rows: Rows, sigma_ray: float, bias: Array, as_it_is: Alignment | str) -> None:
        """Raise SourceError if with the accelerometer's sign turned all fits as well as a start must, and clearly
        better than `as_it_is`."""
        imu = self.imu
        self.imu = [ImuSamples(s.t_ns, s.gyro, -s.accel) for s in imu]
        motions = self._motions(bias)
        self.imu = imu
        found = align(Motions.of(motions), rows, self.T_body_cam, sigma_ray)
        if not isinstance(found, Alignment) or found.behind > 0.2:
            return
        unknown = not self.metric and self._sigma_scale(found, motions) > SIGN_SCALE
        if self._misfit(found) or unknown or (self.metric and self._missing(found, motions)):
            return
        if isinstance(as_it_is, str) or found.chi2 + SIGN_CHI2 < as_it_is.chi2:
            raise SourceError(
                "the accelerometer's sign is turned: images and IMU agree if it is negated (at rest it must read "
                "+9.81 m/s^2 upwards); negate it in the recording"
            )

    def _started(self, found: Alignment, motions: list[Preintegration]) -> Started:
        R0 = upright(found.gravity)
        states = [
            NavState(self.views[i].t_ns, SE3(R0 @ R, R0 @ p), R0 @ v, found.bias_gyro, found.bias_accel)
            for i, R, p, v in zip(self._chosen, found.R, found.p, found.v, strict=True)
        ]
        why = (
            f"in motion: {self._span_s:.2f} s of images, {found.path_m:.2f} m, scale known to {found.sigma_scale:.1%}, "
            f"gravity to {math.degrees(found.sigma_tilt):.2f} deg"
        ) + (f", with {', '.join(self._tags)} in view" if self._tags else "")
        sigma = np.sqrt(np.diag(found.covariance))
        return Started(
            "in motion", why, states, found.sigma_tilt, float(sigma[2:5].max()), float(sigma[5:8].max()),
            float(sigma[8:].max()), self._sigma_scale(found, motions), self._tags,
        )  # fmt: skip


def _drift(found: Alignment, motions: list[Preintegration]) -> float:
    """What the noise of the IMU alone moves the farthest position by, as a share of the way there."""
    far = int(np.argmax(np.linalg.norm(found.p, axis=1)))
    if far == 0:
        return math.inf
    along = found.p[far] / found.path_m
    return math.sqrt(float(along @ motions[far - 1].covariance[3:6, 3:6] @ along)) / found.path_m


def upright(down: Array) -> Array:
    """R_world_body (3, 3) with `down` (3,), in the body's axes, along -z, and the body's x axis over the world's."""
    z = -down / np.linalg.norm(down)
    forward = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 0.0, -1.0 if z[0] > 0 else 1.0])
    x = forward - (forward @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
