"""Corners followed from frame to frame by their patches, new ones where there are none, and their depth.

Pyramidal Lucas-Kanade (OpenCV) from where the gyroscope and the last flow say a corner should be; followed back to
check; held to one motion of all (`geometry.two_view`). With a second camera or a depth image, tracks are measured
there as well. Source: Bouguet 2000; Shi and Tomasi 1994; Kalal 2010 on following back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lodelight.compiled import kernel
from lodelight.errors import CalibrationError, SourceError
from lodelight.features.depth import depth_at
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.geometry.triangulate import triangulate_pairs
from lodelight.geometry.two_view import epipolar_noise, fit_two_view, turn_between
from lodelight.messages import Frame
from lodelight.rig import CameraSpec, Rig
from lodelight.types import AnyArray, Array, ArrayF32, Bools, Bytes, Ints

UNAIDED_SIGMA = 0.01  # rad: of a turn by the images alone, which takes part of the translation for turning
STEREO_BOUND = 2.0  # what calibration adds to the noise across the epipolar plane
LEAST_STEP_PX = 0.03  # no patch is followed better
LEAST_NOISE = 0.5  # of a patch, of the median of all
LEAST_GRADIENT2 = 1e-8  # and likewise of the median noise
LENS_PATCHES, LENS_REACH_RAD = 12, 0.44  # a track that moved so far is off by something else
LEAST_WINDOW_PX, MOST_WINDOW_PX = 9, 21
CONTRAST_GREY = 30.0  # deviation of grey values of a patch at full contrast


@dataclass(frozen=True)
class KltConfig:
    """tracks : so many are kept alive, at least spacing_px apart
    patch_rad, levels : side of a patch, which is to show one thing whatever the resolution; pyramid levels above the
        image
    back_px : a track followed back must return to within this
    min_quality : of a new corner, as a share of a good one's (the 90 % quantile of the best of every cell)
    min_contrast : least smaller eigenvalue of a corner's gradients, in squared grey values a pixel: below is noise
    flat_grey : deviation of grey values of a patch that is raised to half of full contrast; 0 = images as they are
    sigma_px : noise of a track; bound : outlier bound of the common motion in units of it
    wander : over ten frames and more a track leaves its point by so many times what single steps would add up to,
        measured on rendered images (docs/inertial.md)
    lens_rad : what a lens model is off by, alike within patches of the image, of which there are LENS_PATCHES
    """

    tracks: int = 180
    spacing_px: float = 20.0
    patch_rad: float = 0.033
    levels: int = 2
    back_px: float = 0.7
    min_quality: float = 0.05
    min_contrast: float = 4.0
    flat_grey: float = 12.0
    sigma_px: float = 0.5
    bound: float = 3.0
    wander: float = 1.5
    lens_rad: float = 3.3e-4


@dataclass(frozen=True, eq=False)
class Tracks:
    """N corners of camera 0 in one frame, as parallel arrays.

    id : (N,) int64, the same from frame to frame; never used again; age : (N,) int32, frames it was followed for
    px : (N, 2) float32, raw pixels; ray : (N, 3) unit rays, camera 0
    px_right : (N, 2) float32, raw pixels of camera 1, NaN where it was not found there
    inv_depth, sigma_inv_depth : (N,) float64 1/m along camera 0's z, 0 = not measured
    step_px, right_px : (N,) noise of a step from the last frame, and from camera 0 to camera 1
    wander_px2 : (N,) variance of how far the track has left its point since it began
    """

    t_ns: int
    id: NDArray[np.int64]
    age: Ints
    px: ArrayF32
    ray: Array
    px_right: ArrayF32
    inv_depth: Array
    sigma_inv_depth: Array
    step_px: Array
    right_px: Array
    wander_px2: Array

    def __len__(self) -> int:
        return len(self.id)

    @staticmethod
    def none(t_ns: int) -> Tracks:
        px, number = np.zeros((0, 2), np.float32), np.zeros(0)
        columns = (np.zeros(0, np.int64), np.zeros(0, np.int32), px, np.zeros((0, 3)), px)
        return Tracks(t_ns, *columns, number, number, number, number, number)

    @property
    def stereo(self) -> Bools:
        found: Bools = np.isfinite(self.px_right[:, 0])
        return found

    def take(self, index: AnyArray) -> Tracks:
        return replace(
            self, id=self.id[index], age=self.age[index], px=self.px[index], ray=self.ray[index],
            px_right=self.px_right[index], inv_depth=self.inv_depth[index], sigma_inv_depth=self.sigma_inv_depth[index],
            step_px=self.step_px[index], right_px=self.right_px[index], wander_px2=self.wander_px2[index],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Flow:
    """What became of the tracks of the last frame: rotation, R_now_last (3, 3) of camera 0, as the images have it;
    parallax_rad, the median of what translation moved; moved_px, of the whole; followed of `before` tracks; rejected
    ones left the common motion."""

    R_now_last: Array
    parallax_rad: float = 0.0
    moved_px: float = 0.0
    before: int = 0
    followed: int = 0
    rejected: int = 0


class KltTracker:
    """Tracks of a stream of frames. sensors : "mono", "stereo" or "rgbd"; same frames, same bytes."""

    def __init__(self, rig: Rig, sensors: str, config: KltConfig | None = None, seed: int = 0) -> None:
        self.config = config or KltConfig()
        self.spec = rig.cameras[0]
        self.camera = self.spec.camera
        if sensors == "stereo" and len(rig.cameras) < 2:
            raise CalibrationError("stereo was asked for, but the rig has one camera; give it a second one")
        if sensors == "rgbd" and rig.depth is None:
            raise CalibrationError("rgbd was asked for, but the rig has no depth sensor; give it a [depth] table")
        self.right: CameraSpec | None = rig.cameras[1] if sensors == "stereo" else None
        self.depth = rig.depth if sensors == "rgbd" else None
        self.flow = Flow(np.eye(3))
        focal_px = self.camera.focal_px
        half = round(0.5 * (self.config.patch_rad * focal_px - 1.0))
        self._window_px = min(max(2 * half + 1, LEAST_WINDOW_PX), MOST_WINDOW_PX)
        self._lens_px = self.config.lens_rad * focal_px
        self._seed = seed + 1
        self._next_id = 0
        self._last: Bytes | None = None
        self._tracks: Tracks | None = None
        self._drift = np.zeros((0, 2), np.float32)  # of each track, px: its last flow beyond what turning explains

    @property
    def tracks(self) -> Tracks | None:
        """Of the last frame."""
        return self._tracks

    def process(self, frame: Frame, R_now_last: Array | None = None, sigma_rotation: float = 0.03) -> Tracks:
        """Tracks of a frame.

        R_now_last : (3, 3) of camera 0 since the last frame, as believed, each axis within sigma_rotation rad;
            None: by the images alone
        Raises SourceError where an image is not of the rig's size.
        """
        _check_size(frame.images[0], self.spec)
        image = self._evened(frame.images[0])
        if self._last is None or self._tracks is None or len(self._tracks) == 0:
            tracks, drift = Tracks.none(frame.t_ns), np.zeros((0, 2), np.float32)
            self.flow = Flow(np.eye(3))
        else:
            tracks, drift = self._follow(image, frame.t_ns, R_now_last, sigma_rotation)
        followed = len(tracks)
        tracks = _with_new(tracks, self._new_corners(image, tracks), self.camera, self._next_id)
        self._next_id += len(tracks) - followed
        usual = np.median(drift, axis=0) if followed else np.zeros(2)
        drift = np.concatenate([drift, np.tile(usual, (len(tracks) - followed, 1))]).astype(np.float32)
        if self.right is not None:
            tracks = self._measure_stereo(image, frame.images[1], tracks)
        elif self.depth is not None and frame.depth is not None:
            inv_depth, sigma = depth_at(tracks.px, frame.depth, self.depth)
            tracks = replace(tracks, inv_depth=inv_depth.astype(np.float64), sigma_inv_depth=sigma.astype(np.float64))
        self._last, self._tracks, self._drift = image, tracks, drift
        return tracks

    def drop(self, ids: AnyArray) -> None:
        """Follow these tracks no further: the estimator found them wrong."""
        if self._tracks is not None and len(ids):
            keep = ~np.isin(self._tracks.id, ids)
            self._tracks, self._drift = self._tracks.take(keep), self._drift[keep]

    def reset(self) -> None:
        """Forget all tracks; ids go on."""
        self._last, self._tracks = None, None

    # -- parts --------------------------------------------------------------------------------------------------

    def _lens_px2(self, followed: int) -> float:
        """What the lens adds to a track's wander in this frame. Tracks of one patch of the image share its error, and
        together know no more than one of them: each is given as much more noise."""
        share = min(self.flow.moved_px / (LENS_REACH_RAD * self.camera.focal_px), 1.0)
        return 2.0 * self._lens_px**2 * share * max(followed / LENS_PATCHES, 1.0)

    def _evened(self, image: Bytes) -> Bytes:
        """Its difference from the mean around, over the deviation around.

        The lens darkens an image towards its rim, and that does not move with what is seen: a patch of slope g of its
        own and a slope v of the lens's is followed short by v^2 / (g^2 + v^2) of its way. The mean takes it out.
        """
        if self.config.flat_grey <= 0.0:
            return image
        side = (2 * self._window_px + 1, 2 * self._window_px + 1)
        mean, mean2 = (np.asarray(f(image, cv2.CV_32F, side), np.float32) for f in (cv2.boxFilter, cv2.sqrBoxFilter))
        out = np.empty(image.shape, np.uint8)
        _contrast(image, mean, mean2, self.config.flat_grey, out)
        return out

    def _follow(
        self, image: Bytes, t_ns: int, R_now_last: Array | None, sigma_rotation: float
    ) -> tuple[Tracks, ArrayF32]:
        old = self._tracks
        assert old is not None
        assert self._last is not None
        R = np.eye(3) if R_now_last is None else R_now_last
        turned, seen = self.camera.project(old.ray @ R.T)
        guess = np.where(seen[:, None], turned, old.px).astype(np.float32)
        px, found, noise = self._flow(self._last, image, old.px, guess + self._drift)
        keep = np.flatnonzero(found & self.camera.inside(px.astype(np.float64), 2.0))
        ray, real = self.camera.unproject(px[keep].astype(np.float64))
        keep, ray = keep[real], ray[real]
        sigma = self.config.sigma_px / self.camera.focal_px
        if R_now_last is None:
            R, sigma_rotation = turn_between(old.ray[keep], ray), UNAIDED_SIGMA
        R, t, right, parallax = fit_two_view(
            old.ray[keep], ray, np.ascontiguousarray(R), sigma_rotation, sigma, self.config.bound, self._seed
        )
        rad = epipolar_noise(old.ray[keep], ray, R, t, noise[keep])
        step_px = self._scaled(noise[keep], rad * self.camera.focal_px)
        moved = float(np.median(np.linalg.norm(px[keep] - old.px[keep], axis=1))) if len(keep) else 0.0
        self.flow = Flow(R, parallax, moved, len(old), len(keep), int(np.count_nonzero(~right)))
        keep, ray, step_px = keep[right], ray[right], step_px[right]
        n, none = len(keep), np.zeros(len(keep))
        alone = np.full((n, 2), np.nan, np.float32)
        wander_px2 = old.wander_px2[keep] + (self.config.wander * step_px) ** 2 + self._lens_px2(n)
        tracks = Tracks(
            t_ns, old.id[keep], old.age[keep] + np.int32(1), px[keep], ray, alone, none, none, step_px, none, wander_px2
        )
        by_turning, _ = self.camera.project(old.ray[keep] @ R.T)
        return tracks, (px[keep] - by_turning).astype(np.float32)

    def _scaled(self, noise: Array, px: float) -> Array:
        """(N,) px that tracks err by: their patches' noise (N,) times px, or usual ones where that is not known."""
        if not len(noise):
            return noise
        scale = px if math.isfinite(px) else self.config.sigma_px / float(np.median(noise))
        return np.maximum(scale * noise, LEAST_STEP_PX)

    def _flow(self, a: Bytes, b: Bytes, px: ArrayF32, guess: ArrayF32) -> tuple[ArrayF32, Bools, Array]:
        """Where patches of a are in b, which of them return to where they came from, and their noise but for its scale.

        That of Lucas-Kanade's least squares: what is left of the patches' difference over the weaker gradient. Where a
        patch shows two depths, or an edge before another, it is large.
        """
        if len(px) == 0:
            return px, np.zeros(0, bool), np.zeros(0)
        c = self.config
        size, flags = (self._window_px, self._window_px), cv2.OPTFLOW_USE_INITIAL_FLOW
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
        to, ok, left = cv2.calcOpticalFlowPyrLK(
            a, b, px, guess.copy(), None, None, winSize=size, maxLevel=c.levels, criteria=stop, flags=flags
        )
        back, ok_back, gradient2 = cv2.calcOpticalFlowPyrLK(
            b, a, to, px.copy(), None, None, winSize=size, maxLevel=0, criteria=stop,
            flags=flags | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS,
        )  # fmt: skip
        away = np.linalg.norm(np.asarray(back) - px, axis=1)
        good = (np.asarray(ok).ravel() > 0) & (np.asarray(ok_back).ravel() > 0) & (away < c.back_px)
        noise = np.ones(len(px))
        if good.any():
            # of lost tracks these may be anything
            gradient = np.sqrt(np.maximum(np.asarray(gradient2).ravel()[good].astype(np.float64), LEAST_GRADIENT2))
            noise[good] = np.asarray(left).ravel()[good].astype(np.float64) / gradient
            noise[good] = np.maximum(noise[good], LEAST_NOISE * max(float(np.median(noise[good])), LEAST_GRADIENT2))
        return np.asarray(to, np.float32), good, noise

    def _new_corners(self, image: Bytes, tracks: Tracks) -> ArrayF32:
        """(M, 2) px of corners where no track is, the best first."""
        missing = self.config.tracks - len(tracks)
        if missing <= 0:
            return np.zeros((0, 2), np.float32)
        height, width = image.shape
        half = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        score = np.asarray(cv2.cornerMinEigenVal(half, 3, ksize=3), np.float32)
        cell = 0.5 * math.sqrt(height * width / self.config.tracks)
        # the eigenvalue is of sums over nine pixels of Sobel gradients scaled by 1 / (255 * 4 * 3), squared
        floor = self.config.min_contrast / (255.0 * 3.0) ** 2
        px = best_corners(
            score, tracks.px, cell, 0.5 * self.config.spacing_px, missing, self.config.min_quality, floor
        )  # fmt: skip
        return px

    def _measure_stereo(self, left: Bytes, right: Bytes, tracks: Tracks) -> Tracks:
        """Tracks with their pixels in camera 1, and the inverse depth both cameras give."""
        assert self.right is not None
        _check_size(right, self.right)
        right, expected = self._evened(right), self._expected_inv_depth(tracks)
        measured = self._in_right(left, right, tracks, expected)
        if not expected.any() and measured.stereo.any():  # the first: what is as far as most is found from there
            usual = np.median(measured.inv_depth[measured.stereo])
            measured = self._in_right(left, right, tracks, np.full(len(tracks), usual))
        return measured

    def _in_right(self, left: Bytes, right: Bytes, tracks: Tracks, inv_depth: Array) -> Tracks:
        """Tracks as found from where points of inv_depth (N,), 1/m, would be."""
        assert self.right is not None
        T = self.right.T_body_cam.inverse() @ self.spec.T_body_cam
        guess, seen = self.right.camera.project(tracks.ray @ T.R.T + (inv_depth * tracks.ray[:, 2])[:, None] * T.t)
        start = np.where(seen[:, None], guess, tracks.px).astype(np.float32)
        px, found, patch = self._flow(left, right, tracks.px, start)
        found &= self.right.camera.inside(px.astype(np.float64), 1.0)
        ray, real = self.right.camera.unproject(px.astype(np.float64))
        rows = np.flatnonzero(found & real)
        sigma = np.full(len(rows), STEREO_BOUND * self.config.sigma_px / self.camera.focal_px)
        xyz, good = triangulate_pairs(
            SE3.identity(), tracks.ray[rows], sigma, T.inverse(), ray[rows], sigma, max_relative_sigma=math.inf
        )
        rows, z = rows[good], xyz[good, 2]
        along = T.t / np.linalg.norm(T.t)
        rad = epipolar_noise(tracks.ray[rows], ray[rows], np.ascontiguousarray(T.R), along, patch[rows])
        px_right, right_px = np.full_like(tracks.px, np.nan), np.zeros(len(tracks))
        measured, sigmas = np.zeros(len(tracks)), np.zeros(len(tracks))
        px_right[rows] = px[rows]
        measured[rows] = 1.0 / z
        # a pixel of disparity is focal length times baseline of inverse depth
        sigmas[rows] = math.sqrt(2.0) * self.config.sigma_px / (self.camera.focal_px * float(np.linalg.norm(T.t)))
        own_px = self._scaled(patch[rows], rad * self.camera.focal_px)
        right_px[rows] = np.hypot(self.config.wander * own_px, self._lens_px)
        return replace(tracks, px_right=px_right, inv_depth=measured, sigma_inv_depth=sigmas, right_px=right_px)

    def _expected_inv_depth(self, tracks: Tracks) -> Array:
        """(N,) 1/m: as last measured, or else the median of those that were."""
        out = np.zeros(len(tracks))
        last = self._tracks
        if last is None or not (last.inv_depth > 0).any():
            return out
        out[:] = np.median(last.inv_depth[last.inv_depth > 0])
        _, row, row_last = np.intersect1d(tracks.id, last.id, assume_unique=True, return_indices=True)
        known = last.inv_depth[row_last] > 0
        out[row[known]] = last.inv_depth[row_last[known]]
        return out


@kernel
def _contrast(image: Bytes, mean: ArrayF32, mean2: ArrayF32, flat: float, out: Bytes) -> None:
    gain, floor, grey = np.float32(CONTRAST_GREY), np.float32(flat), np.float32(128.5)
    least, most = np.float32(0.0), np.float32(255.0)
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            m = mean[i, j]
            deviation = np.sqrt(max(mean2[i, j] - m * m, least))
            value = grey + gain * (np.float32(image[i, j]) - m) / (deviation + floor)
            out[i, j] = np.uint8(np.int32(min(max(value, least), most)))


def _check_size(image: Bytes, spec: CameraSpec) -> None:
    camera = spec.camera
    if image.shape != (camera.height, camera.width):
        raise SourceError(
            f"image is {image.shape[1]}x{image.shape[0]}, but the rig's {spec.name} is "
            f"{camera.width}x{camera.height}; correct the rig or the recording"
        )


def _with_new(old: Tracks, fresh: ArrayF32, camera: Camera, first_id: int) -> Tracks:
    """The tracks and, behind them, those that begin at pixels (M, 2) where the lens has a ray."""
    ray, real = camera.unproject(fresh.astype(np.float64))
    fresh, ray = fresh[real], ray[real]
    n = len(fresh)
    step_px = float(np.median(old.step_px)) if len(old) else LEAST_STEP_PX
    return replace(
        old, id=np.concatenate([old.id, np.arange(first_id, first_id + n)]),
        age=np.concatenate([old.age, np.zeros(n, np.int32)]), px=np.concatenate([old.px, fresh]),
        ray=np.concatenate([old.ray, ray]), px_right=np.full((len(old) + n, 2), np.nan, np.float32),
        inv_depth=np.zeros(len(old) + n), sigma_inv_depth=np.zeros(len(old) + n),
        step_px=np.concatenate([old.step_px, np.full(n, step_px)]), right_px=np.zeros(len(old) + n),
        wander_px2=np.concatenate([old.wander_px2, np.zeros(n)]),
    )  # fmt: skip


@kernel
def best_corners(
    score: ArrayF32, px: ArrayF32, cell: float, apart: float, wanted: int, quality: float, floor: float
) -> ArrayF32:
    """(M, 2) px of the best corner of every cell far enough from all tracks, the best of them first.

    score (H, W) : of an image of half the size; px (N, 2) : tracks, pixels of the whole; cell, apart : half pixels
    A corner counts if its score is above `quality` of a good one's, and above `floor`.
    """
    height, width = score.shape
    columns, rows = math.ceil(width / cell), math.ceil(height / cell)
    taken = np.zeros((height, width), np.bool_)
    for k in range(len(px)):
        x, y = 0.5 * (px[k, 0] - 0.5), 0.5 * (px[k, 1] - 0.5)
        _cover(taken, x, y, apart)
    best, u, v = np.zeros(columns * rows, np.float32), np.zeros(columns * rows), np.zeros(columns * rows)
    margin = 6
    column = np.empty(width, np.int64)
    for x in range(width):
        column[x] = int(x / cell)
    for y in range(margin, height - margin):
        row = int(y / cell) * columns
        for x in range(margin, width - margin):
            s = score[y, x]
            at = row + column[x]
            if s <= best[at] or taken[y, x]:
                continue
            if (
                s >= score[y - 1, x] and s >= score[y + 1, x] and s >= score[y, x - 1] and s >= score[y, x + 1]
                and s >= score[y - 1, x - 1] and s >= score[y + 1, x + 1] and s >= score[y - 1, x + 1]
                and s >= score[y + 1, x - 1]
            ):  # fmt: skip
                best[at], u[at], v[at] = s, x, y
    order = np.argsort(-best, kind="mergesort")
    good = best[order[len(order) // 10]]
    out = np.empty((wanted, 2), np.float32)
    n = 0
    for at in order:
        if n == wanted or best[at] <= max(floor, quality * good):
            break
        x, y = int(u[at]), int(v[at])
        if taken[y, x]:  # by one of a neighbouring cell
            continue
        _cover(taken, u[at], v[at], apart)
        out[n, 0], out[n, 1] = 2.0 * u[at] + 0.5, 2.0 * v[at] + 0.5
        n += 1
    return out[:n]


@kernel
def _cover(taken: Bools, x: float, y: float, radius: float) -> None:
    for v in range(max(int(y - radius), 0), min(int(y + radius) + 1, taken.shape[0] - 1) + 1):
        for u in range(max(int(x - radius), 0), min(int(x + radius) + 1, taken.shape[1] - 1) + 1):
            if (u - x) ** 2 + (v - y) ** 2 <= radius * radius:
                taken[v, u] = True
