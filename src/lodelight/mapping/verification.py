"""Does an image show this part of the map, and where was it taken? What loops and relocalization have in common.

The image's descriptors are matched to those of one keyframe; a pose is drawn from the matches (P3P in RANSAC),
refined, and used to look for all points of the neighbourhood, those that did not match at first included. Chance
agreement of a few repeated details passes the first step now and then; it does not find the rest of the place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.estimation.pose import PoseResult, optimize_pose
from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex, consistent_turn, match_descriptors
from lodelight.features.orb import OrbConfig
from lodelight.geometry.pnp import ransac_pnp
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.mapping.sight import in_sight, points_of_keyframes
from lodelight.rig import CameraSpec
from lodelight.types import AnyArray, Array, ArrayF32, Ints, Words

MIN_AGREEING = 10  # matches, and of them those that fit one pose, below which it is not worth looking on
MATCH_HAMMING = 64
MATCH_RATIO = 0.8
WINDOWS_PX = (10.0, 4.0)  # in which points are looked for, one after another, in pixels of the feature's own scale
WINDOW_HAMMING = 64
PARALLAX = 0.25  # rad: how far apart two views are from which a descriptor still matches, for the most part
MAX_DEPTH_SIGMA = 0.5  # of a depth: beyond, its uncertainty has no Gaussian shape any more
ELSEWHERE_M, ELSEWHERE_DEG = 0.5, 10.0  # poses farther apart than a map is bent are of two places
GRID = (8, 6)  # cells of the image over which the spread of inliers is counted


@dataclass(frozen=True, eq=False)
class Location:
    """Where an image was taken, by the map points it shows.

    covariance : (6, 6), chart of SE3.perturbed
    feature, point : (K,) inliers, feature of the image and id of the map point
    n_expected : points of the neighbourhood that should be seen from there
    coverage : of the cells of the image where points should be seen, the share that has an inlier
    """

    T_world_body: SE3
    covariance: Array
    feature: Ints
    point: Ints
    n_expected: int
    coverage: float

    def __len__(self) -> int:
        return len(self.point)


@dataclass(frozen=True)
class Refusal:
    """Why an image is not believed to show a place. inliers : points or matches that agreed on a pose, at best"""

    why: str
    inliers: int = 0


def elsewhere(T_world_body: SE3, other: SE3) -> bool:
    """Whether two answers to where an image was taken are two places, and not one in a map that is a little bent."""
    apart = T_world_body.inverse() @ other
    return bool(np.linalg.norm(apart.t) > ELSEWHERE_M or np.degrees(apart.angle) > ELSEWHERE_DEG)


class Verifier:
    """Locates images in parts of a map.

    orb : what the features were extracted with; sigma_px : noise of a corner at the finest octave
    spec : the camera of the images, where it is not the map's
    whole_place : a first pose is drawn from matches with all points around, not with what one keyframe saw alone
    min_agreeing : matches that must fit a first pose for it to be worth looking on
    """

    def __init__(
        self, map: Map, orb: OrbConfig, sigma_px: float, spec: CameraSpec | None = None, whole_place: bool = False,
        min_agreeing: int = MIN_AGREEING,
    ) -> None:  # fmt: skip
        spec = spec or map.rig.cameras[0]
        self.map = map
        self.orb = orb
        self.sigma_px = sigma_px
        self.camera = spec.camera
        self.T_body_cam = spec.T_body_cam
        self.whole_place = whole_place
        self.min_agreeing = min_agreeing

    def neighbourhood(self, keyframe: int, excluded: AnyArray | None = None, size: int = 10) -> Ints:
        """A keyframe and those that share most points with it, without the excluded ones."""
        around, _ = self.map.covisible(keyframe)
        if excluded is not None:
            around = around[~np.isin(around, excluded)]
        return np.append(np.int32(keyframe), around[:size])

    def locate(self, seen: Features, keyframe: int, neighbourhood: Ints) -> Location | Refusal:
        """Where `seen` was taken if it shows what `keyframe` shows, or why it is not believed to.

        neighbourhood : keyframes whose points are looked for
        The answer is as sure as its inliers are many, spread, and a large part of what should be visible; the caller
        sets those bounds. Source: science note B2.
        """
        points = points_of_keyframes(self.map, neighbourhood)
        matches = self._matches_place(seen, points) if self.whole_place else self._matches(seen, keyframe)
        pose = self._draw(seen, *matches)
        if isinstance(pose, Refusal):
            return pose
        index = FeatureIndex(seen, self.camera.width, self.camera.height)
        for window_px in WINDOWS_PX:
            sight = in_sight(self.map, points, pose, self.T_body_cam, self.camera, self.orb)
            blur_px, _ = self._depth_blur(sight.point, pose)
            radius = window_px * self.orb.scale(sight.octave) + np.minimum(2.0 * blur_px, 2.0 * window_px)
            match = index.search(
                sight.px, radius, (sight.octave - 1, sight.octave + 1), self.map.points.desc[sight.point],
                max_hamming=WINDOW_HAMMING,
            )  # fmt: skip
            hit = np.flatnonzero(match >= 0)
            feature, point = match[hit], sight.point[hit]
            solved = self._solve(pose, seen.take(feature), point)
            if solved.n_inliers < MIN_AGREEING:
                why = f"{solved.n_inliers} of {len(sight.point)} points are where they should be"
                return Refusal(why, solved.n_inliers)
            pose = solved.T_world_body
        feature, point = feature[solved.inliers], point[solved.inliers]
        expected, shown = self._cells(sight.px), self._cells(seen.px[feature])
        return Location(
            pose, solved.covariance, feature, point, len(sight.point),
            len(np.intersect1d(expected, shown)) / max(len(expected), 1),
        )  # fmt: skip

    def explained(
        self, located: Location, seen: Features, T_world_body: SE3, window_px: float = WINDOWS_PX[-1]
    ) -> float:
        """Share of the inliers of `seen` that another pose of it would also put near their features."""
        xyz = self.map.points.xyz[located.point]
        px, visible = self.camera.project((T_world_body @ self.T_body_cam).inverse() @ xyz)
        off_px = np.linalg.norm(px - seen.px[located.feature], axis=1)
        blur_px, _ = self._depth_blur(located.point, T_world_body)
        near = off_px < window_px * self.orb.scale(seen.octave[located.feature]) + np.minimum(2.0 * blur_px, window_px)
        return float(np.mean(near & visible))

    def _matches(self, seen: Features, keyframe: int) -> tuple[Ints, Ints]:
        """(K,) features of an image, and the points that look like them, by descriptors as one keyframe saw them."""
        there, point = self.map.features_of(keyframe), self.map.points_of(keyframe)
        there, point = there.take(point >= 0), point[point >= 0]
        return self._alike(seen, there.desc, there.angle, point)

    def _matches_place(self, seen: Features, points: Ints) -> tuple[Ints, Ints]:
        """As `_matches`, of points by their own descriptors: what any of the keyframes around saw, each once."""
        angle = self.map.features.angle[self.map.points.head[points]]
        return self._alike(seen, self.map.points.desc[points], angle, points)

    def _alike(self, seen: Features, desc: Words, angle: ArrayF32, point: Ints) -> tuple[Ints, Ints]:
        match = match_descriptors(desc, seen.desc, MATCH_HAMMING, MATCH_RATIO)
        hit = np.flatnonzero(match >= 0)
        hit = hit[consistent_turn(angle[hit], seen.angle[match[hit]])]
        return match[hit], point[hit]

    def _draw(self, seen: Features, feature: Ints, point: Ints) -> SE3 | Refusal:
        """A first pose, from matches (K,) of features and points of which many may be wrong."""
        if len(feature) < self.min_agreeing:
            return Refusal(f"{len(feature)} descriptors match, {self.min_agreeing} are needed")
        seen = seen.take(feature)
        sigma_rad = np.hypot(self._sigma_px(seen) / self.camera.focal_px, PARALLAX * self._depth_sigma(point))
        found = ransac_pnp(seen.ray, self.map.points.xyz[point], sigma_rad, seed=0)
        agreeing = 0 if found is None else int(found[1].sum())
        if found is None or agreeing < self.min_agreeing:
            return Refusal(
                f"{agreeing} of {len(feature)} matches fit one pose, {self.min_agreeing} are needed", agreeing
            )
        T_world_cam, inliers = found
        start = T_world_cam @ self.T_body_cam.inverse()
        return self._solve(start, seen.take(inliers), point[inliers]).T_world_body

    def _solve(self, start: SE3, seen: Features, point: Ints) -> PoseResult:
        """Motion-only optimization, features against points, each as sure as both are."""
        blur_px, blur_inv_depth = self._depth_blur(point, start)
        return optimize_pose(
            start, self.T_body_cam, self.camera, self.map.points.xyz[point], seen.px,
            np.hypot(self._sigma_px(seen), blur_px), seen.inv_depth, np.hypot(seen.sigma_inv_depth, blur_inv_depth),
        )  # fmt: skip

    def _depth_sigma(self, point: Ints) -> Array:
        """Standard deviation (M,) of points along the ray of the keyframe that saw them last, as a share of depth.

        Zero for those from triangulation; a sighting with depth is averaged with the others of its point.
        """
        p, f = self.map.points, self.map.features
        row = p.head[point]
        inv_depth = f.inv_depth[row].astype(np.float64)
        share = np.divide(f.sigma_inv_depth[row], inv_depth, out=np.zeros(len(row)), where=inv_depth > 0)
        out: Array = np.minimum(share / np.sqrt(p.n_obs[point]), MAX_DEPTH_SIGMA)
        return out

    def _depth_blur(self, point: Ints, T_world_body: SE3) -> tuple[Array, Array]:
        """What the uncertainty of points' own depth makes of their pixels, px, and of their inverse depths, 1/m.

        A point known from one stereo pair is known far better across its ray than along it, and from elsewhere part
        of the way along shows.
        """
        k, by = self.map.keyframes, self.map.features.keyframe[self.map.points.head[point]]
        centre = k.p[by] + k.R[by] @ self.map.rig.cameras[0].T_body_cam.t
        xyz = self.map.points.xyz[point]
        farther = centre + (xyz - centre) / (1.0 - self._depth_sigma(point))[:, None]
        T_cam_world = (T_world_body @ self.T_body_cam).inverse()
        near, far = T_cam_world @ xyz, T_cam_world @ farther
        moved = self.camera.project(far)[0] - self.camera.project(near)[0]
        return np.hypot(moved[:, 0], moved[:, 1]), np.abs(1.0 / near[:, 2] - 1.0 / far[:, 2])

    def _sigma_px(self, seen: Features) -> Array:
        return self.sigma_px * self.orb.scale(seen.octave)

    def _cells(self, px: AnyArray) -> Ints:
        """The distinct cells of the image that hold pixels (N, 2)."""
        column = (px[:, 0] * GRID[0] / self.camera.width).astype(np.int32).clip(0, GRID[0] - 1)
        row = (px[:, 1] * GRID[1] / self.camera.height).astype(np.int32).clip(0, GRID[1] - 1)
        return np.unique(row * GRID[0] + column)
