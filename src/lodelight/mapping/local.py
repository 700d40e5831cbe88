"""Local mapping: what happens to the map when a keyframe enters it.

`insert` is the quick half that tracking waits for: the keyframe and points from its depth. `process` is the rest:
points that proved bad go, new ones are triangulated with the neighbours, doubles are fused, poses and points of the
neighbourhood are adjusted together, and keyframes that add nothing go.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lodelight.estimation.bundle import bundle_adjust
from lodelight.estimation.bundle_problem import BundleProblem
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.estimation.factors.reprojection import CHI2_PX
from lodelight.features.epipolar import match_epipolar
from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3, carried_covariance
from lodelight.geometry.triangulate import triangulate_pairs
from lodelight.mapping import kernels
from lodelight.mapping.map import Map
from lodelight.mapping.sight import in_sight, points_of_keyframes
from lodelight.mapping.tag_corners import with_tag_corners
from lodelight.types import AnyArray, Array, Bools, Ints

# Keyframes that see a point, below which it is not worth its keyframe once that is old. With an IMU keyframes come by
# the way that was flown, whatever is known; in known space each finds corners that were missed before, and with those
# it would stay for ever.
CONFIRMED = 3


@dataclass(frozen=True)
class LocalMappingConfig:
    """sigma_px : noise of a corner at the finest octave
    close_sigma : a depth this uncertain or better, as a share of itself, makes a point from one keyframe
    min_close : so many of the best depths make points even where they are worse
    neighbours : keyframes with which points are triangulated and fused
    window : keyframes adjusted together; min_shared : points that make a keyframe part of it
    redundant : share of a keyframe's points that others see as well, above which it is culled
    found_ratio : a point found in a smaller share of the frames that should see it is culled
    min_parallax_mono_deg : of corners that make a point where no sensor tells the scale: with less, the errors of two
        poses pass for parallax, and a camera that turns on the spot shrinks its world
    iterations : of the adjustment at a keyframe; the next keyframe's goes on where it ended
    """

    sigma_px: float = 1.0
    close_sigma: float = 0.05
    min_close: int = 100
    neighbours: int = 8
    window: int = 20
    min_shared: int = 15
    redundant: float = 0.9
    found_ratio: float = 0.25
    min_parallax_mono_deg: float = 1.15
    iterations: int = 5


class LocalMapper:
    """Writes the map. All methods take the map's lock where they change it."""

    def __init__(self, map: Map, orb: OrbConfig, config: LocalMappingConfig) -> None:
        self.map = map
        self.orb = orb
        self.config = config
        self.camera = map.rig.cameras[0].camera
        self.T_body_cam = map.rig.cameras[0].T_body_cam
        self.hold_poses = False  # keyframes stay where they were put; only points are adjusted
        self.min_parallax = 0.0  # rad, of corners that make a point
        self._young: list[tuple[int, Ints]] = []  # keyframe and the points it made, until they have proved themselves

    # -- the two halves -----------------------------------------------------------------------------------------

    def insert(
        self, t_ns: int, T_world_body: SE3, seen: Features, point: Ints, weight: float, parent: int, noise: float = 1.0
    ) -> int:
        """A keyframe with its matches (N,) and new points from its depth; returns its id."""
        map = self.map
        keyframe = map.add_keyframe(t_ns, T_world_body, seen, weight, parent, noise)
        first = map.feature_range(keyframe).start
        point = map.surviving(point)
        matched = np.flatnonzero(point >= 0)
        _, once = np.unique(point[matched], return_index=True)  # two of them may have been fused since
        matched = matched[np.sort(once)]
        map.link(first + matched, point[matched])
        map.refresh_points(point[matched], self.orb.scale_factor, self.orb.n_levels)
        fresh = np.flatnonzero((point < 0) & self.close(seen))
        xyz = (T_world_body @ self.T_body_cam) @ points_at_depth(seen.take(fresh))
        made = map.add_points(xyz, (first + fresh).astype(np.int32), keyframe)
        map.refresh_points(made, self.orb.scale_factor, self.orb.n_levels)
        self._young.append((keyframe, made))
        return keyframe

    def process(self, keyframe: int, stop: Callable[[], bool] | None = None) -> None:
        """The slow half. `stop` is asked between the iterations of the adjustment."""
        with self.map.lock:
            self._cull_young_points(keyframe)
            self._triangulate(keyframe)
            self._fuse(keyframe)
        self._adjust(keyframe, stop)
        with self.map.lock:
            self._cull_keyframes(keyframe)

    def add_seen(self, xyz: Array, keyframes: Sequence[int], rows: Sequence[AnyArray]) -> Ints:
        """New points (M, 3) m, and for every keyframe the corner (M,) of it that sees each, -1 = none; returns ids.

        The first keyframe sees all of them.
        """
        map = self.map
        points = map.add_points(xyz, (map.feature_range(keyframes[0]).start + rows[0]).astype(np.int32), keyframes[0])
        for keyframe, row in zip(keyframes[1:], rows[1:], strict=True):
            sees = row >= 0
            map.link((map.feature_range(keyframe).start + row[sees]).astype(np.int32), points[sees])
        map.refresh_points(points, self.orb.scale_factor, self.orb.n_levels)
        return points

    def close(self, seen: Features) -> Bools:
        """Which features have a depth good enough to make a point of it, or are among the best `min_close`."""
        relative = np.where(seen.inv_depth > 0, seen.sigma_inv_depth / np.maximum(seen.inv_depth, 1e-9), np.inf)
        good: Bools = relative < self.config.close_sigma
        if np.count_nonzero(good) < self.config.min_close:
            best = np.argsort(relative, kind="stable")[: self.config.min_close]
            good[best[np.isfinite(relative[best])]] = True
        return good

    def renumber(self, new_point: Ints) -> None:
        """Points have other numbers: see `compact.squeeze`."""
        self._young = [(born, _kept(new_point[points])) for born, points in self._young]

    # -- parts --------------------------------------------------------------------------------------------------

    def _cull_young_points(self, keyframe: int) -> None:
        p, kept = self.map.points, []
        for born, points in self._young:
            points = points[p.alive[points]]
            age = keyframe - born
            bad = p.n_found[points] < self.config.found_ratio * p.n_visible[points]
            if age >= 2:
                has_depth = self.map.features.inv_depth[p.head[points]] > 0
                bad |= p.n_obs[points] < np.where(has_depth, 2, 3)
            self.map.remove_points(points[bad])
            if age < 3:
                kept.append((born, points[~bad]))
        self._young = kept

    def _triangulate(self, keyframe: int) -> None:
        """New points from features that no point explains yet, matched along epipolar planes with neighbours."""
        map = self.map
        here = map.features_of(keyframe)
        made = []
        for other in self._neighbours(keyframe):
            free = np.flatnonzero(map.points_of(keyframe) < 0)
            there = map.features_of(other)
            free_there = np.flatnonzero(map.points_of(other) < 0)
            if len(free) == 0 or len(free_there) == 0:
                continue
            a, b = here.take(free), there.take(free_there)
            T_world_a = map.pose(keyframe) @ self.T_body_cam
            T_world_b = map.pose(other) @ self.T_body_cam
            sigma_a, sigma_b = self._sigma_rad(a.octave), self._sigma_rad(b.octave)
            match = match_epipolar(a, b, T_world_b.inverse() @ T_world_a, sigma_b)
            ia = np.flatnonzero(match >= 0)
            ib = match[ia]
            xyz, good = triangulate_pairs(
                T_world_a, a.ray[ia], sigma_a[ia], T_world_b, b.ray[ib], sigma_b[ib], min_parallax=self.min_parallax
            )
            points = self.add_seen(xyz[good], (keyframe, other), (free[ia[good]], free_there[ib[good]]))
            made.append(points)
        if made:
            self._young.append((keyframe, np.concatenate(made)))

    def _fuse(self, keyframe: int) -> None:
        """Points of this keyframe and of its neighbours that are the same point become one."""
        neighbours = self._neighbours(keyframe)
        radius_px = math.sqrt(CHI2_PX) * self.config.sigma_px
        for other in neighbours:
            fuse_into(
                self.map, other, points_of_keyframes(self.map, np.array([keyframe], np.int32)), self.orb, radius_px
            )
        theirs = points_of_keyframes(self.map, np.array(neighbours, np.int32))
        fuse_into(self.map, keyframe, theirs, self.orb, radius_px)
        own = self.map.points_of(keyframe)
        self.map.refresh_points(own[own >= 0], self.orb.scale_factor, self.orb.n_levels)

    def _adjust(self, keyframe: int, stop: Callable[[], bool] | None) -> None:
        """Local bundle adjustment around a keyframe; observations that do not fit are unlinked."""
        map = self.map
        with map.lock:
            neighbours, _ = map.covisible(keyframe, self.config.min_shared)
        window = np.append(neighbours[: self.config.window - 1], keyframe).astype(np.int32)
        newest = None if self.hold_poses else keyframe
        adjust(
            map, window, self.orb, self.config.sigma_px, self.config.iterations, stop, newest=newest,
            hold_poses=self.hold_poses,
        )  # fmt: skip

    def _cull_keyframes(self, keyframe: int) -> None:
        map, kf = self.map, self.map.keyframes
        candidates, _ = map.covisible(keyframe, self.config.min_shared)
        candidates = candidates[np.argsort(kf.weight[candidates], kind="stable")]
        protected = {keyframe, *map.loops.a.tolist(), *map.loops.b.tolist()}
        for other in candidates:
            if int(other) in protected or kf.parent[other] < 0:
                continue
            rows = map.feature_range(int(other))
            settled = self.hold_poses and keyframe - other > self.config.window
            share = kernels.redundant_share(
                rows.start, rows.stop, map.features.point, map.features.next, map.features.octave,
                map.points.head, map.points.n_obs, CONFIRMED if settled else 1,
            )  # fmt: skip
            if share > self.config.redundant:
                map.remove_keyframe(int(other))

    def _neighbours(self, keyframe: int) -> list[int]:
        neighbours, _ = self.map.covisible(keyframe, self.config.min_shared)
        return [int(k) for k in neighbours[: self.config.neighbours]]

    def _sigma_rad(self, octave: Ints) -> Array:
        out: Array = self.config.sigma_px / self.camera.focal_px * self.orb.scale(octave)
        return out


def _kept(points: Ints) -> Ints:
    return points[points >= 0]


def points_at_depth(seen: Features) -> Array:
    """(N, 3) m in the camera frame, where the features' own depths put them."""
    out: Array = seen.ray / (seen.ray[:, 2] * seen.inv_depth)[:, None]
    return out


def fuse_into(map: Map, keyframe: int, points: Ints, orb: OrbConfig, radius_px: float) -> None:
    """Find points in a keyframe's image, within radius_px at the finest octave of where they should be.

    A feature that had no point gets one, one that had another makes the two the same.
    """
    own = map.points_of(keyframe)
    points = points[~np.isin(points, own[own >= 0])]
    spec = map.rig.cameras[0]
    sight = in_sight(map, points, map.pose(keyframe), spec.T_body_cam, spec.camera, orb)
    index = FeatureIndex(map.features_of(keyframe), spec.camera.width, spec.camera.height)
    match = index.search(
        sight.px, radius_px * orb.scale(sight.octave), (sight.octave - 1, sight.octave + 1),
        map.points.desc[sight.point], max_hamming=50,
    )  # fmt: skip
    found = match >= 0
    map.join(map.feature_range(keyframe).start + match[found], sight.point[found])


def adjust(
    map: Map,
    window: Ints,
    orb: OrbConfig,
    sigma_px: float,
    iterations: int,
    stop: Callable[[], bool] | None,
    newest: int | None = None,
    hold_poses: bool = False,
    pose_sigma: tuple[float, float] | None = None,
) -> None:
    """Bundle adjustment of `window` keyframes and what they see; observations that do not fit are unlinked.

    newest : keyframe whose covariance is found as well; hold_poses : only points are adjusted
    pose_sigma : poses are believed where they stand, to so many rad and m; None = not at all
    """
    with map.lock:
        problem, keyframes, points, rows = bundle_of(map, window, orb, sigma_px)
        tied = with_tag_corners(map, problem, keyframes, window)
        if hold_poses:
            tied = replace(tied, fixed=np.ones(len(tied.fixed), bool))
        if pose_sigma is not None:
            tied = replace(tied, priors=[*tied.priors, *_where_they_stand(tied, pose_sigma)])
    wanted = [] if newest is None else [int(np.searchsorted(keyframes, newest))]
    result = bundle_adjust(tied, iterations=iterations, stop=stop, covariance_of=wanted)
    with map.lock:
        commit_bundle(map, result.R, result.p, result.xyz[: len(points)], tied.fixed, keyframes, points)
        if newest is not None:
            _set_covariance(map, newest, result.covariance[0], tied, keyframes)
        still = map.features.point[rows] == points[problem.point]
        map.unlink(rows[~result.inliers[: len(rows)] & still])
        map.refresh_points(points[map.points.alive[points]], orb.scale_factor, orb.n_levels)


def _where_they_stand(problem: BundleProblem, pose_sigma: tuple[float, float]) -> list[PosePrior]:
    information = np.diag(np.repeat(pose_sigma, 3) ** -2.0)
    return [PosePrior(int(k), SE3(problem.R[k], problem.p[k]), information) for k in np.flatnonzero(~problem.fixed)]


def bundle_of(map: Map, window: Ints, orb: OrbConfig, sigma_px: float) -> tuple[BundleProblem, Ints, Ints, Ints]:
    """The adjustment of `window` keyframes, all points they see, and (held fixed) all others that see those.

    Returns the problem, the keyframe ids and point ids of its rows, and the feature row of each observation.
    """
    points = points_of_keyframes(map, window)
    rows = kernels.rows_of_points(points, map.points.head, map.features.next, map.points.n_obs)
    observer = map.features.keyframe[rows]
    keyframes = np.unique(np.concatenate([window, observer])).astype(np.int32)
    tied = map.anchoring.holds(window)  # to the world; else the root is what the map hangs on
    fixed = ~np.isin(keyframes, window) | (~np.bool_(tied) & (map.keyframes.parent[keyframes] < 0))
    f = map.features
    noise = map.keyframes.noise[observer]
    problem = BundleProblem(
        camera=map.rig.cameras[0].camera,
        T_body_cam=map.rig.cameras[0].T_body_cam,
        R=map.keyframes.R[keyframes],
        p=map.keyframes.p[keyframes],
        fixed=fixed,
        xyz=map.points.xyz[points],
        keyframe=np.searchsorted(keyframes, observer).astype(np.int32),
        point=np.searchsorted(points, f.point[rows]).astype(np.int32),
        px=f.px[rows].astype(np.float64),
        sigma_px=sigma_px * noise * orb.scale(f.octave[rows]),
        inv_depth=f.inv_depth[rows].astype(np.float64),
        sigma_inv_depth=noise * f.sigma_inv_depth[rows],
        weight=map.keyframes.weight[observer],
        priors=map.anchoring.priors(keyframes, window),
        lights=map.anchoring.views(keyframes, window),
    )
    return problem, keyframes, points, rows


def _set_covariance(map: Map, keyframe: int, relative: Array, problem: BundleProblem, keyframes: Ints) -> None:
    """The adjustment's covariance is against the poses it held fixed: add what the one with most ties to it carries."""
    held = np.flatnonzero(problem.fixed)
    total = relative
    if len(held):
        ties = np.bincount(problem.keyframe, minlength=len(keyframes))[held]
        anchor = int(keyframes[held[np.argmax(ties)]])
        total = relative + carried_covariance(map.pose(anchor), map.keyframes.covariance[anchor], map.pose(keyframe))
    map.keyframes.covariance[keyframe] = total


def commit_bundle(map: Map, R: Array, p: Array, xyz: Array, fixed: Bools, keyframes: Ints, points: AnyArray) -> None:
    """Write adjusted poses (of keyframes that were free) and points back."""
    free = keyframes[~fixed]
    map.keyframes.R[free] = R[~fixed]
    map.keyframes.p[free] = p[~fixed]
    map.points.xyz[points] = xyz
