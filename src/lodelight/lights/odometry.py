"""A stream of sightings to a stream of fixes: who each light is, where the body was, or why not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np

from lodelight.anchors import Light
from lodelight.errors import CalibrationError
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew, so3_log
from lodelight.lights.positioning import CHI2_2_99, Solution, Views, misfits, solve
from lodelight.lights.two_lights import poses_from_two_lights
from lodelight.messages import LightFix, LightSighting
from lodelight.rig import CameraSpec
from lodelight.types import Array

TILT_DEG = 0.5
PIXEL_FLOOR = 0.3  # sigma of a centre, with what the lens and the face's unevenness add (science note A3)
RANGE_RATIO = 1.6  # a light's face may look that much wider or narrower than its radius says
MEMORY_S = 2.0  # for how long the last fix tells lights of one code apart
FASTEST_M_S, SLACK_M = 2.5, 0.5
SPREAD_RATIO = 1.5  # by which the second assignment's lights must be farther apart than the first's
TWIST_S = 0.35  # two fixes nearer in time than this tell how the body moves
MIRRORED = "the lights fit one pose only when their map is mirrored"
NS = 1e-9


@dataclass(eq=False)
class LightOdometry:
    """Feed it the sightings of one image after another.

    spec : the light camera; sigma_tilt_deg : of a level mounting about either horizontal axis, or of what the IMU's
    filter does not know: its accelerometer's bias
    """

    spec: CameraSpec
    lights: tuple[Light, ...]
    sigma_tilt_deg: float = TILT_DEG
    sigma_floor_px: float = PIXEL_FLOOR
    _last: tuple[int, SE3] | None = field(default=None, init=False)
    _twist: Array | None = field(default=None, init=False)
    _sigma_tilt_rad: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._by_id = {light.id: light for light in self.lights}

    def locate(
        self, sightings: Sequence[LightSighting], up_body: Array | None = None, sigma_up_rad: float = 0.0
    ) -> LightFix:
        """Of the body at the mean stamp of the named sightings. up_body : unit; None: the body's z is up.

        sigma_up_rad : of up, beside sigma_tilt_deg

        Raises CalibrationError where the lights' map fits only when mirrored.
        """
        up_body = np.array([0.0, 0.0, 1.0]) if up_body is None else up_body
        self._sigma_tilt_rad = math.hypot(math.radians(self.sigma_tilt_deg), sigma_up_rad)
        return replace(self._located(sightings, up_body), up_body=up_body, sigma_up_rad=self._sigma_tilt_rad)

    def _located(self, sightings: Sequence[LightSighting], up_body: Array) -> LightFix:
        seen = [s for s in sightings if s.candidates]
        t_ns = round(float(np.mean([s.t_ns - sightings[0].t_ns for s in seen]))) + sightings[0].t_ns if seen else 0
        if len(seen) < 2:
            return LightFix(t_ns, None, np.full((6, 6), np.inf), tuple(s.candidates[0] for s in seen if s.id), 0.0,
                            "no light named" if not seen else "one light only: its yaw is unknown")  # fmt: skip
        up_cam = self.spec.T_body_cam.R.T @ up_body
        solution, views, why = self._assigned(seen, t_ns, up_cam)
        if solution is None:
            named = [s.id for s in seen if s.id is not None]
            if why == MIRRORED and self._last is None and len(named) == len(seen):
                raise CalibrationError(
                    f"the map of lights is a mirror image: {', '.join(named)} fit only with one horizontal axis "
                    "reversed; a ceiling drawn as seen from below has x or y the wrong way round in anchors.toml"
                )
            return LightFix(t_ns, None, np.full((6, 6), np.inf), tuple(named), 0.0, why)
        assert views is not None
        return self._fix(t_ns, solution, views)

    def _fix(self, t_ns: int, solution: Solution, views: Views) -> LightFix:
        T = solution.T_world_cam @ self.spec.T_body_cam.inverse()
        T_cam_body = self.spec.T_body_cam.inverse()
        A = np.zeros((6, 6))
        A[:3, :3] = self.spec.T_body_cam.R
        A[3:, :3] = -solution.T_world_cam.R @ skew(T_cam_body.t)
        A[3:, 3:] = np.eye(3)
        if self._last is not None and 0 < (t_ns - self._last[0]) * NS < TWIST_S:
            dt_s = (t_ns - self._last[0]) * NS
            turn = so3_log(np.ascontiguousarray(self._last[1].R.T @ T.R))
            self._twist = np.concatenate([turn, T.t - self._last[1].t]) / dt_s
        else:
            self._twist = None
        self._last = (t_ns, T)
        pixels = misfits(solution.T_world_cam, views) * self.spec.camera.focal_px
        return LightFix(t_ns, T, A @ solution.covariance @ A.T, tuple(light.id for light in views.lights),
                        float(np.sqrt(np.mean(pixels**2))))  # fmt: skip

    def _views(self, seen: Sequence[LightSighting], lights: tuple[Light, ...], t_ns: int, up_cam: Array) -> Views:
        rays, _ = self.spec.camera.unproject(np.array([s.centre_px for s in seen]))
        rays = rays / rays[:, 2:]
        sigma = np.array([max(s.sigma_px, self.sigma_floor_px) for s in seen]) / self.spec.camera.focal_px
        moved = np.zeros((len(seen), 6))
        if self._twist is not None and self._last is not None and (t_ns - self._last[0]) * NS < TWIST_S:
            dt_s = np.array([(s.t_ns - t_ns) * NS for s in seen])
            turn = self.spec.T_body_cam.R.T @ self._twist[:3]
            moved = dt_s[:, None] * np.concatenate([turn, self._twist[3:]])
        return Views(rays, sigma, lights, moved, up_cam, self._sigma_tilt_rad)

    def _assigned(
        self, seen: Sequence[LightSighting], t_ns: int, up_cam: Array
    ) -> tuple[Solution | None, Views | None, str]:
        """The lights of one code are told apart by the last fix, or else by which lie closest together."""
        options = [self._best(list(lights), seen, t_ns, up_cam) for lights in self._hypotheses(seen, t_ns, up_cam)]
        fits = [(s, v, why) for s, v, why in options if s is not None and v is not None]
        if not fits:
            return None, options[0][1] if options else None, options[0][2] if options else "no pose sees these lights"
        if self._last is not None and (t_ns - self._last[0]) * NS < MEMORY_S:
            reach = SLACK_M + FASTEST_M_S * (t_ns - self._last[0]) * NS
            T_cam_body = self.spec.T_body_cam.inverse()
            near = [f for f in fits if np.linalg.norm((f[0].T_world_cam @ T_cam_body).t - self._last[1].t) < reach]
            if near:
                return min(near, key=lambda f: f[0].cost - 100.0 * len(f[1].lights))
        fits.sort(key=lambda f: (-len(f[1].lights), _spread(f[1])))
        rivals = [f for f in fits[1:] if len(f[1].lights) == len(fits[0][1].lights)]
        if rivals and _spread(rivals[0][1]) < SPREAD_RATIO * _spread(fits[0][1]):
            return None, None, "several lights have these codes, and more than one place fits"
        return fits[0]

    def _hypotheses(self, seen: Sequence[LightSighting], t_ns: int, up_cam: Array) -> list[tuple[Light | None, ...]]:
        """One light for each sighting. Two sightings place the camera, and the others take the nearest they expect."""
        if all(s.id for s in seen):
            return [tuple(self._by_id[s.candidates[0]] for s in seen)]
        found: dict[tuple[str, ...], tuple[Light | None, ...]] = {}
        for i, j in combinations(range(len(seen)), 2):
            for a, b in product(seen[i].candidates, seen[j].candidates):
                pair = self._views([seen[i], seen[j]], (self._by_id[a], self._by_id[b]), t_ns, up_cam)
                for T in poses_from_two_lights(pair.rays, pair.xyz, up_cam):
                    lights = tuple(self._expected(s, T) for s in seen)
                    if lights[i] and lights[j]:
                        found.setdefault(tuple(light.id if light else "" for light in lights), lights)
        return list(found.values())

    def _expected(self, sighting: LightSighting, T_world_cam: SE3) -> Light | None:
        """Of the lights with its code, the one seen nearest to it, if as large as it looks and within its width."""
        best, nearest = None, sighting.diameter_rows
        for name in sighting.candidates:
            light = self._by_id[name]
            X = T_world_cam.R.T @ (light.xyz - T_world_cam.t)
            if X[2] < 0.05:
                continue
            width = 2.0 * light.radius_m * self.spec.camera.focal_px / X[2]
            if not 1.0 / RANGE_RATIO < width / sighting.diameter_rows < RANGE_RATIO:
                continue
            px, _ = self.spec.camera.project(X[None])
            off = float(np.linalg.norm(px[0] - sighting.centre_px))
            if off < nearest:
                best, nearest = light, off
        return best

    def _best(
        self, lights: list[Light | None], seen: Sequence[LightSighting], t_ns: int, up_cam: Array
    ) -> tuple[Solution | None, Views | None, str]:
        """A pose of all, or of all but those that fit least: one of four to six, two of seven to nine."""
        rows = [i for i, light in enumerate(lights) if light is not None]
        chosen = tuple(light for light in lights if light is not None)
        if len({light.id for light in chosen}) < len(chosen):
            return None, None, "one light is seen twice"
        views = self._views([seen[i] for i in rows], chosen, t_ns, up_cam)
        whole = views
        solution = solve(views)
        if len(chosen) >= 3 and (solution is None or not _fitting(solution)) and fits_mirrored(whole):
            return None, whole, MIRRORED
        spare = (len(chosen) - 1) // 3  # fewer agree by chance
        while solution is not None and not _fitting(solution):
            if len(chosen) - len(views.lights) >= spare:
                solution = None
                break
            worst = int(np.argmax(solution.chi2))
            views = views.of([i for i in range(len(views.lights)) if i != worst])
            solution = solve(views)
        if solution is None:
            return None, whole, "the lights do not fit one pose: a wrong survey, name or level"
        return solution, views, ""


def _fitting(solution: Solution) -> bool:
    return bool((solution.chi2 < CHI2_2_99).all() and solution.tilt2 < CHI2_2_99)


def _spread(views: Views) -> float:
    xyz = views.xyz
    return float(np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).max())


def fits_mirrored(views: Views) -> bool:
    """Whether the lights fit one pose when one horizontal axis of their map is reversed."""
    flip = np.array([-1.0, 1.0, 1.0])
    lights = tuple(replace(light, xyz=light.xyz * flip, normal=light.normal * flip) for light in views.lights)
    solution = solve(replace(views, lights=lights))
    return solution is not None and _fitting(solution)
