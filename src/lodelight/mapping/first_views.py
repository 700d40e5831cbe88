"""A map begun by one camera: views of the same corners from several places, where nothing measures a depth.

Corners of the first view are found again from frame to frame. The essential matrix that most of the first and the last
agree on (five points, in OpenCV) gives a motion and points, the points give the views in between, and all is adjusted
together. What a homography explains as well is flat or was seen from one place only, and what does not fit the views in
between was the wrong one of several motions: both wait for more. A tag of known size that two views show gives the
scale; without one the map is as large as is supposed. Source: Nister 2004; Hartley and Zisserman 2003, 9.6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from lodelight.estimation.bundle import bundle_adjust
from lodelight.estimation.bundle_problem import BundleProblem, as_f64
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.estimation.factors.reprojection import CHI2_PX
from lodelight.features.features import Features
from lodelight.features.matching import HAMMING_STRICT, FeatureIndex, consistent_turn
from lodelight.features.orb import OrbConfig
from lodelight.geometry.pnp import ransac_pnp
from lodelight.geometry.se3 import SE3
from lodelight.geometry.triangulate import Triangulated, triangulate_rays
from lodelight.messages import TagSighting
from lodelight.rig import CameraSpec
from lodelight.tags.pose import tag_poses
from lodelight.types import AnyArray, Array, Bools, Ints

SUPPOSED_M = 3.0  # median distance of the first points, for want of a scale: as far as things are in a room
WINDOW_PX, RATIO = 40.0, 0.9  # around where a corner was last and the others have gone since
AHEAD_COSINE = 0.2  # of the optical axis: rays that are used to find the motion, which OpenCV wants as z = 1
BOUND, BOUND_2 = 1.96, 2.45  # 95 % of distances from a line and from a point lie within so many standard deviations
FAR = 1e6  # baselines, up to which a point may vote for being ahead
PROBABILITY = 0.9999  # that a draw of right matches only was among those tried
HELD = 1e-3  # to what share of itself the length of the way between them is held
ITERATIONS = 30
LEAST_RIVAL = 8  # points with parallax that a motion needs to be one
RIVAL_CHI2, APART_RAD = 25.0, math.radians(5.0)  # five standard deviations more misfit, and another motion is refuted


@dataclass(frozen=True)
class FirstViewsConfig:
    """min_matches : corners of the first view found again, below which the next one is the first
    min_points : with a distance known to max_relative_sigma of itself, to begin a map
    max_flat : matches that one plane, or a turn alone, explains, as a share of those that the motion does
    min_fit : share of the corners of every view that must fit in the end
    max_direction_deg : one standard deviation of the direction from the first view to the last
    views : kept, the first and the last among them
    """

    min_matches: int = 100
    min_points: int = 50
    max_relative_sigma: float = 0.1
    max_flat: float = 0.8
    min_fit: float = 0.8
    max_direction_deg: float = 3.0
    views: int = 6


@dataclass(frozen=True, eq=False)
class FirstView:
    """t_ns, seen, tags : of an image; T_world_body : adjusted; row (M,) : the corner of each point in `seen`, or -1"""

    t_ns: int
    seen: Features
    tags: tuple[TagSighting, ...]
    T_world_body: SE3
    row: Ints


@dataclass(frozen=True, eq=False)
class Begun:
    """Views and what they see. xyz (M, 3) : in the first body's frame, in m if `metric`, else of SUPPOSED_M from it in
    the median; misfit : chi-square of all observations, those that do not fit at their bound; lacks : what is missing
    before a map may begin of it, which it may contest meanwhile"""

    views: list[FirstView]
    xyz: Array
    metric: bool
    misfit: float
    lacks: str = ""


class FirstViews:
    """Takes views until they make a map. sigma_px : noise of a corner at the finest octave"""

    def __init__(
        self, spec: CameraSpec, orb: OrbConfig, sigma_px: float, config: FirstViewsConfig, seed: int = 0
    ) -> None:
        self.spec, self.orb, self.sigma_px, self.config, self.seed = spec, orb, sigma_px, config, seed
        self._views: list[FirstView] = []  # their rows are of the first view's corners, their poses nothing yet
        self._every, self._since = 1, 0  # frames from one view that is kept to the next
        self._last_px = np.zeros((0, 2))  # of the first view's corners, where they were seen last
        self._flow_px = np.zeros(2)  # of one frame

    def feed(self, t_ns: int, seen: Features, tags: Sequence[TagSighting] = ()) -> Begun | str:
        """The views so far with this one as a map, or what is missing to make one of them. tags : of known size"""
        this = FirstView(t_ns, seen, tuple(tags), SE3.identity(), np.arange(len(seen), dtype=np.int32))
        if not self._views:
            self._begin(this)
            return "one camera alone begins a map with views from two places; this is the first"
        last = replace(this, row=self._found(seen))
        n_found = int(np.count_nonzero(last.row >= 0))
        if n_found < self.config.min_matches:
            self._begin(this)
            return f"{n_found} corners of the first view found again, {self.config.min_matches} are needed; begun anew"
        begun = self._made_of([*self._views, last])
        self._keep(last)
        return begun

    # -- the views ----------------------------------------------------------------------------------------------

    def _begin(self, first: FirstView) -> None:
        self._views = [first]
        self._every, self._since = 1, 0
        self._last_px, self._flow_px = first.seen.px.astype(np.float64), np.zeros(2)

    def _keep(self, view: FirstView) -> None:
        """As one of few, that stay evenly spread over the time since the first."""
        self._since += 1
        if self._since >= self._every:
            self._views.append(view)
            self._since = 0
        if len(self._views) > self.config.views:
            self._views = self._views[::2]
            self._every *= 2

    def _found(self, here: Features) -> Ints:
        """(N,) which corner of this view each of the first view's is, -1 where it is not found."""
        there, camera = self._views[0].seen, self.spec.camera
        index = FeatureIndex(here, camera.width, camera.height)
        expected = np.clip(self._last_px + self._flow_px, 0.0, [camera.width - 1.0, camera.height - 1.0])
        radius = np.full(len(there), WINDOW_PX)
        octaves = there.octave - 1, there.octave + 1
        match = index.search(expected, radius, octaves, there.desc, max_hamming=HAMMING_STRICT, ratio=RATIO)
        a = np.flatnonzero(match >= 0)
        match[a[~consistent_turn(there.angle[a], here.angle[match[a]])]] = -1
        a = np.flatnonzero(match >= 0)
        if len(a):
            self._flow_px = np.median(here.px[match[a]] - self._last_px[a], axis=0)
        self._last_px += self._flow_px
        self._last_px[a] = here.px[match[a]]
        return match

    # -- the map ------------------------------------------------------------------------------------------------

    def _made_of(self, views: list[FirstView]) -> Begun | str:
        """The map of the motion that fits most, if no other fits nearly as well."""
        first, last = views[0], views[-1]
        corner = np.flatnonzero(last.row >= 0).astype(np.int32)
        there, here = first.seen.take(corner), last.seen.take(last.row[corner])
        motions, flat = self._motions(there, here)
        if flat > self.config.max_flat:
            return f"{100 * flat:.0f} % of the matches fit a turn or a plane as well; move sideways"
        made = [self._made_by(views, corner, T_first_last, there, here) for T_first_last in motions]
        possible = sorted((m for m in made if isinstance(m, Begun)), key=lambda m: m.misfit)
        if not possible:
            return next((m for m in made if isinstance(m, str)), "no motion was found")
        best = possible[0]
        if any(_differ(best, m) and m.misfit < best.misfit + RIVAL_CHI2 for m in possible[1:]):
            return "two motions fit what is seen; move on"
        return best.lacks or best

    def _motions(self, there: Features, here: Features) -> tuple[list[SE3], float]:
        """How the camera may have moved between two views of the same corners; translations are one long.

        The essential matrix's motion and, as what is seen may be nearly flat, those that a plane leaves possible.
        Returns T_there_here of each, and how many corners a homography explains, as a share of what the first does.
        """
        ahead = np.flatnonzero((there.ray[:, 2] > AHEAD_COSINE) & (here.ray[:, 2] > AHEAD_COSINE))
        if len(ahead) < self.config.min_points:
            return [], 0.0
        there, here = there.take(ahead), here.take(ahead)
        a, b = (seen.ray[:, :2] / seen.ray[:, 2:] for seen in (there, here))
        sigma = np.hypot(self._sigma_rad(there), self._sigma_rad(here))
        usual = float(np.median(sigma))
        E, found = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, PROBABILITY, BOUND * usual / math.sqrt(2.0))
        H, _ = cv2.findHomography(a, b, cv2.RANSAC, BOUND_2 * usual, confidence=PROBABILITY)
        if E is None or E.shape != (3, 3) or H is None:
            return [], 0.0
        _, R, t, *_ = cv2.recoverPose(E, a, b, np.eye(3), distanceThresh=FAR, mask=found)
        at_point = np.linalg.norm(cv2.perspectiveTransform(a[:, None], H)[:, 0] - b, axis=1) < BOUND_2 * sigma
        flat = np.count_nonzero(at_point) / max(int(np.count_nonzero(found)), 1)
        n, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        motions = [(R, t), *zip(rotations[:n], translations[:n], strict=True)]
        return [_moved(R, t) for R, t in motions if np.linalg.norm(t) > 0], flat

    def _made_by(
        self, views: list[FirstView], corner: Ints, T_first_last: SE3, there: Features, here: Features
    ) -> Begun | str:
        """The map that one motion makes of the views. corner : of the first view, that the last one shows as well"""
        config = self.config
        normal = np.cross(T_first_last.t, here.ray @ T_first_last.R.T)
        off = np.abs(np.einsum("ni,ni->n", normal, there.ray)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
        agree = off < BOUND * np.hypot(self._sigma_rad(there), self._sigma_rad(here))
        n_agree = np.count_nonzero(agree)
        if n_agree < config.min_points:
            return f"{n_agree} matches agree on a motion, {config.min_points} are needed to begin a map"
        found = self._points([(views[0], SE3.identity()), (views[-1], T_first_last)], corner[agree])
        good = self._good(found)
        if np.count_nonzero(good) < LEAST_RIVAL:
            return self._too_few(int(np.count_nonzero(good)))
        poses = self._between(views, corner[agree][good], found.xyz[good], T_first_last)
        if poses is None:
            return "the views in between do not fit the first and the last one"
        n_seen = sum(int(np.count_nonzero(view.row[corner] >= 0)) for view in views)
        return self._adjusted(views, poses, corner[agree][found.in_front], found.xyz[found.in_front], n_seen)

    def _between(self, views: list[FirstView], corner: Ints, xyz: Array, T_first_last: SE3) -> list[SE3] | None:
        """T_first_camera of every view by the points of some corners; None where one does not fit."""
        poses = [SE3.identity()]
        for view in views[1:-1]:
            row = view.row[corner]
            seen = view.seen.take(row[row >= 0])
            drawn = ransac_pnp(seen.ray, xyz[row >= 0], self._sigma_rad(seen), self.seed)
            if drawn is None or np.count_nonzero(drawn[1]) < self.config.min_fit * len(seen):
                return None
            poses.append(drawn[0])
        return [*poses, T_first_last]

    def _adjusted(self, views: list[FirstView], poses: list[SE3], corner: Ints, xyz: Array, n_seen: int) -> Begun | str:
        """All views and points together, and the whole as large as tags say or is supposed.

        n_seen : observations there are, of which those of other corners do not fit
        """
        T_body_cam = self.spec.T_body_cam
        bodies = [T_body_cam @ T @ T_body_cam.inverse() for T in poses]
        rows = [view.row[corner] for view in views]
        which = [np.flatnonzero(row >= 0).astype(np.int32) for row in rows]
        seen = [view.seen.take(row[row >= 0]) for view, row in zip(views, rows, strict=True)]
        n = sum(map(len, seen))
        fixed = np.arange(len(views)) == 0
        problem = BundleProblem(
            self.spec.camera, T_body_cam, np.stack([T.R for T in bodies]), np.stack([T.t for T in bodies]), fixed,
            T_body_cam @ xyz, np.repeat(np.arange(len(views), dtype=np.int32), list(map(len, seen))),
            np.concatenate(which), np.concatenate([s.px for s in seen]).astype(np.float64),
            self.sigma_px * np.concatenate([self.orb.scale(s.octave) for s in seen]), np.zeros(n), np.ones(n),
            priors=[_of_length(len(views) - 1, bodies[-1])],
        )  # fmt: skip
        result = bundle_adjust(problem, ITERATIONS, covariance_of=[len(views) - 1])
        doubt = _doubt_of_direction(result.p[-1] - result.p[0], result.covariance[0][3:, 3:])
        at = 0
        for k, there in enumerate(which):
            fits = result.inliers[at : at + len(there)]
            at += len(there)
            if np.count_nonzero(fits) < self.config.min_fit * len(fits):
                return f"{np.count_nonzero(fits)} of {len(fits)} corners of view {k} fit all the others"
            rows[k] = rows[k].copy()
            rows[k][there[~fits]] = -1
        bodies = [SE3(R, p) for R, p in zip(result.R, result.p, strict=True)]
        views = [replace(v, T_world_body=T, row=row) for v, T, row in zip(views, bodies, rows, strict=True)]
        found = self._points([(v, v.T_world_body @ T_body_cam) for v in views], np.arange(len(corner), dtype=np.int32))
        good = self._good(found) & (views[0].row >= 0)
        misfit = float(np.minimum(result.chi2, CHI2_PX).sum()) + CHI2_PX * (n_seen - n)
        lacks = ""
        if np.count_nonzero(good) < self.config.min_points:
            lacks = self._too_few(int(np.count_nonzero(good)))
        elif doubt > math.radians(self.config.max_direction_deg):
            lacks = f"the direction of motion is known to {math.degrees(doubt):.0f} deg only; move sideways"
        if lacks:
            return Begun(views, found.xyz[good], False, misfit, lacks)
        scale = self._scale_by_tags(views)
        metric = scale is not None
        origin = T_body_cam.t
        if scale is None:
            scale = SUPPOSED_M / float(np.median(np.linalg.norm(found.xyz[good] - origin, axis=1)))
        scaled = []
        for v in views:  # about the first camera, so that the lever from it to the body keeps its length
            T_cam = v.T_world_body @ T_body_cam
            T = SE3(T_cam.R, origin + scale * (T_cam.t - origin)) @ T_body_cam.inverse()
            scaled.append(replace(v, T_world_body=T, row=v.row[good]))
        return Begun(scaled, origin + scale * (found.xyz[good] - origin), metric, misfit)

    def _scale_by_tags(self, views: list[FirstView]) -> float | None:
        """By how much the views are to be scaled for tags to have their size; None where none tells."""
        scales = []
        for name in sorted({tag.name for view in views for tag in view.tags}):
            sees = [(view, tag) for view in views for tag in view.tags if tag.name == name]
            rays, sigma, centres, away_m = [], [], [], []
            for view, tag in sees:
                poses = tag_poses(tag, tag.size_m or 0.0, self.spec.camera)
                if poses:
                    T_cam, centre = view.T_world_body @ self.spec.T_body_cam, poses[0].T_cam_tag.t
                    away_m.append(float(np.linalg.norm(centre)))  # the two poses that may fit differ in their turn only
                    rays.append(T_cam.R @ (centre / away_m[-1]))
                    sigma.append(float(np.mean(tag.sigma_px)) / self.spec.camera.focal_px)
                    centres.append(T_cam.t)
            if len(rays) < 2:
                continue
            found = triangulate_rays(np.array(centres), np.array(rays), np.array(sigma), np.array([0, len(rays)]))
            if self._good(found)[0]:
                scales += [m / float(np.linalg.norm(found.xyz[0] - c)) for m, c in zip(away_m, centres, strict=True)]
        return float(np.median(scales)) if scales else None

    def _points(self, placed: list[tuple[FirstView, SE3]], corner: Ints) -> Triangulated:
        """The points of some corners by all views that see them; placed : views, and where their cameras are."""
        centre = np.stack([np.broadcast_to(T.t, (len(corner), 3)) for _, T in placed], axis=1)
        rows = np.stack([view.row[corner] for view, _ in placed], axis=1)
        ray = np.stack([view.seen.ray[view.row[corner]] @ T.R.T for view, T in placed], axis=1)
        sigma = np.stack([self._sigma_rad(view.seen.take(view.row[corner])) for view, _ in placed], axis=1)
        there = rows >= 0
        start = np.concatenate([[0], np.cumsum(np.count_nonzero(there, axis=1))])
        return triangulate_rays(centre[there], ray[there], sigma[there], start)

    def _good(self, found: Triangulated) -> Bools:
        known: Bools = found.in_front & (found.relative_sigma < self.config.max_relative_sigma)
        return known

    def _sigma_rad(self, seen: Features) -> Array:
        out: Array = self.sigma_px / self.spec.camera.focal_px * self.orb.scale(seen.octave)
        return out

    def _too_few(self, n: int) -> str:
        return f"{n} points have parallax enough, {self.config.min_points} are needed to begin a map; move sideways"


def _of_length(view: int, T_world_body: SE3) -> PosePrior:
    """Holds the distance from the origin, which nothing else does, and no more."""
    length = float(np.linalg.norm(T_world_body.t))
    along = T_world_body.t / length
    information = np.zeros((6, 6))
    information[3:, 3:] = np.outer(along, along) / (HELD * length) ** 2
    return PosePrior(view, T_world_body, information)


def _doubt_of_direction(way: Array, covariance: Array) -> float:
    """rad: the largest standard deviation of the direction of `way` (3,), of which a covariance is known."""
    length = float(np.linalg.norm(way))
    across = np.eye(3) - np.outer(way, way) / length**2
    return math.sqrt(max(float(np.linalg.eigvalsh(across @ covariance @ across)[-1]), 0.0)) / length


def _moved(R_here_there: AnyArray, t_here: AnyArray) -> SE3:
    """T_there_here, its translation one long, of a motion as OpenCV has it."""
    T = SE3(as_f64(R_here_there), as_f64(np.ravel(t_here))).inverse()
    return SE3(T.R, T.t / np.linalg.norm(T.t))


def _differ(a: Begun, b: Begun) -> bool:
    """Whether two maps of the same views are more than one and the same by another way."""
    ways = [m.views[-1].T_world_body.t / np.linalg.norm(m.views[-1].T_world_body.t) for m in (a, b)]
    return math.acos(min(max(float(ways[0] @ ways[1]), -1.0), 1.0)) > APART_RAD
