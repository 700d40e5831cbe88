"""Follows a camera in the current map: the points of the map around it, which nobody writes, and temporary points.

While a frame is matched, one array says what each feature is: a map point p as p, a temporary point t as -2 - t,
nothing as -1. What the map reads of it takes every negative number for nothing, so no temporary point can be taken
for one of the map's. A finished `Tracked` has the two kinds apart.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from lodelight.estimation.factors.reprojection import CHI2_PX
from lodelight.estimation.pose import PoseResult
from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.localization.influence import MOST, leverage
from lodelight.localization.motion import Motion
from lodelight.localization.reckoning import Reckoned
from lodelight.localization.temporary import TemporaryPoints
from lodelight.localization.tracker import INLIERS, MAJORITY, NARROW, Landmarks, Tracked, Tracker, TrackerConfig
from lodelight.mapping.map import Map
from lodelight.mapping.sight import in_sight, keyframes_near, local_keyframes, points_of_keyframes
from lodelight.rig import Rig
from lodelight.types import Array, Bools, Ints

FIRST_TEMPORARY = -2
ENOUGH_VOTES = 30  # matches with the map, from which its own covisibility says best what is around
NOISES = (1.0, 1.4, 2.0)  # of a frame over a sharp one's, at which right matches are told from wrong ones
ENOUGH_MEASURED, OPEN_M = 10, 0.03  # points whose distance is known do without others if so many, and so exact
MOST_DECIDING = 5  # points that decide a pose alone, in one frame
CLOSER = 2.0  # windows, where in those before most matches were by chance
NEAR_M, NEAR_DEG, NEAREST = 8.0, 60.0, 20  # else keyframes from so near, turned by so little, at most so many


class Follower(Tracker):
    """A tracker that leaves the map as it is.

    temporary : the overlay, empty while the map is enough
    reckoned : where the body is in the next frame by its IMU, None without one
    """

    def __init__(
        self,
        rig: Rig,
        map: Map,
        orb: OrbConfig,
        config: TrackerConfig,
        temporary: TemporaryPoints,
        seed: int = 0,
    ) -> None:
        super().__init__(rig, map, orb, config, seed)
        self.temporary = temporary
        self.reckoned: Reckoned | None = None

    def track(self, t_ns: int, seen: Features) -> Tracked:
        """As `Tracker.track`; where an IMU says where the camera should be, around there."""
        last, reckoned = self.last, self.reckoned
        if reckoned is None or last is None or t_ns <= last.t_ns:
            return super().track(t_ns, seen)
        dt_s = (t_ns - last.t_ns) * 1e-9
        moved = self._moved_with_map(last).inverse() @ reckoned.T_map_body
        self._motion = Motion(moved.log() / dt_s, reckoned.covariance / dt_s**2)
        tracked = super().track(t_ns, seen)
        return self.track_at(t_ns, seen, reckoned.T_map_body) if tracked.why_lost else tracked

    def forget(self) -> None:
        """The camera may be anywhere now."""
        self.last = None
        self._motion = Motion()

    def forget_temporary(self) -> None:
        """Clear the overlay, and the last frame's matches with it."""
        self.temporary.clear()
        if self.last is not None:
            self.last.temporary = None

    def by_map_alone(self, t_ns: int, seen: Features, T_world_body: SE3, point: Ints | None = None) -> Tracked:
        """A frame by the map's points alone, from a pose that is nearly right on; point : (N,) matches so far."""
        index = FeatureIndex(seen, self.camera.width, self.camera.height)
        known = np.full(len(seen), -1, np.int32) if point is None else point
        return self.refine(t_ns, seen, T_world_body, known, index, search=5.0, map_alone=True)

    def refine(
        self,
        t_ns: int,
        seen: Features,
        T_world_body: SE3,
        point: Ints,
        index: FeatureIndex,
        search: float,
        map_alone: bool = False,
    ) -> Tracked:
        """As `Tracker.refine`, in the current map; point : (N,) matches so far, of both kinds.

        map_alone : without temporary points
        Where most matches with the map are by chance, they hold the pose off and take corners from temporary points:
        it is had without them if more agree so, and from there all is matched once more in closer windows.
        """
        map = self.map
        voting = self._around(T_world_body, point)
        sight = in_sight(map, points_of_keyframes(map, voting), T_world_body, self.T_body_cam, self.camera, self.orb)
        mapped = np.where(point >= 0, point, -1).astype(np.int32)
        mapped = self._matched(sight, map.points.desc[sight.point], mapped, mapped < 0, index, search)
        carried = np.where((point <= FIRST_TEMPORARY) & (mapped < 0), FIRST_TEMPORARY - point, -1).astype(np.int32)
        use_overlay = not map_alone and len(self.temporary.table) > 0
        if map_alone:
            carried[:] = -1
        if use_overlay:
            around = self.temporary.in_sight(T_world_body)
            free = (mapped < 0) & (carried < 0)
            carried = self._matched(around, self.temporary.table.desc[around.point], carried, free, index, search)
        posed = partial(self._posed, t_ns, seen, T_world_body, reference=int(voting[0]), window=NARROW * search)
        tracked = posed(mapped, carried)
        if tracked.right_in_map < MAJORITY * tracked.n_inliers:
            nothing = np.full(len(seen), -1, np.int32)
            if np.any(carried >= 0):
                without = posed(nothing, carried)
                if without.right_in_all >= tracked.right_in_all:
                    mapped, tracked = nothing, without
            if search > CLOSER and not map_alone:
                alone = np.where(carried >= 0, FIRST_TEMPORARY - carried, -1).astype(np.int32)
                return self.refine(t_ns, seen, tracked.T_world_body, alone, index, CLOSER)
        if np.any(carried >= 0) and _is_open(tracked):
            tracked = posed(mapped, carried, guess=True)
        if use_overlay:
            assert tracked.temporary is not None
            self.temporary.count(around.point, tracked.temporary[tracked.temporary >= 0])
            tracked.temporary = self.temporary.alive(tracked.temporary)
        return tracked

    def _posed(
        self, t_ns: int, seen: Features, start: SE3, mapped: Ints, carried: Ints, window: float, reference: int,
        guess: bool = False,
    ) -> Tracked:  # fmt: skip
        """The pose by matches of both kinds (N,), each found within `window` sigmas of where it was expected.

        guess : by those whose distance is not known, too; else they are only tested
        """
        used = np.flatnonzero((mapped >= 0) | (carried >= 0))
        of_map, with_distance = mapped[used] >= 0, mapped[used] >= 0
        xyz, spread = np.empty((len(used), 3)), np.zeros(len(used))
        xyz[of_map] = self.map.points.xyz[mapped[used[of_map]]]
        prior = None
        if not of_map.all():
            others = carried[used[~of_map]]
            xyz[~of_map] = self.temporary.table.xyz[others]
            with_distance[~of_map] = self.temporary.measured(others)
            centre = (start @ self.T_body_cam).t
            spread[~of_map] = self.camera.focal_px * self.temporary.uncertainty(others, centre)
            prior = self._expected(t_ns)
        weight = np.where(of_map, 1.0, np.where(with_distance | guess, self.temporary.config.weight, 0.0))
        solved, noise = self._solve_without_leverage(start, seen.take(used), xyz, weight, spread, prior)
        chi2 = noise**2 * solved.chi2
        in_map, in_all, measured = (
            _right(chi2[those], solved.inliers[those], window * self.config.sigma_px)
            for those in (of_map, np.ones(len(used), np.bool_), with_distance)
        )
        point, temporary = np.full(len(seen), -1, np.int32), np.full(len(seen), -1, np.int32)
        agree = used[solved.inliers]
        point[agree], temporary[agree] = mapped[agree], np.where(mapped[agree] >= 0, -1, carried[agree])
        why = f"{in_all} of {len(used)} matches with the local map agree beyond chance"
        return Tracked(
            t_ns, seen, solved.T_world_body, solved.covariance, point, reference, noise, temporary=temporary,
            right_in_map=in_map, right_in_all=in_all, measured=measured, guessed=guess,
            why_lost=why if in_all < self.config.min_inliers else "",
        )  # fmt: skip

    def _solve_without_leverage(
        self, start: SE3, seen: Features, xyz: Array, weight: Array, spread: Array, prior: tuple[SE3, Array] | None
    ) -> tuple[PoseResult, float]:
        """As `_solve`, by points of which none decides by itself: those are only tested at the end."""
        weight = weight.copy()
        for _ in range(MOST_DECIDING):
            solved, noise = self._solve(start, seen, xyz, weight, spread, prior)
            held = leverage(
                solved.T_world_body, self.T_body_cam, self.camera, xyz, seen.px,
                np.hypot(noise * self._sigma_px(seen), spread),
                seen.inv_depth, noise * seen.sigma_inv_depth, np.where(solved.inliers, weight, 0.0),
            )  # fmt: skip
            most = int(np.argmax(held)) if len(held) else 0
            if not len(held) or held[most] <= MOST:
                break
            weight[most] = 0.0
        return solved, noise

    def _expected(self, t_ns: int) -> tuple[SE3, Array] | None:
        """Where the camera should be by how it moved, and the information (6, 6) of that; None where nothing is known:
        points without a distance leave it open how far it went."""
        last = self.last
        if last is None or last.why_lost or t_ns <= last.t_ns:
            return None
        dt_s = (t_ns - last.t_ns) * 1e-9
        motion, T_world_last = self._motion.later(dt_s), self._moved_with_map(last)
        turned = np.eye(6)
        turned[3:, 3:] = T_world_last.R
        covariance = last.covariance + dt_s**2 * turned @ motion.covariance @ turned.T
        return T_world_last @ self._motion.over(dt_s), np.linalg.inv(covariance)

    def distances(self, tracked: Tracked) -> Array:
        """(K,) m of the map's points that a frame sees."""
        centre = (tracked.T_world_body @ self.T_body_cam).t
        out: Array = np.linalg.norm(self.map.points.xyz[tracked.point[tracked.point >= 0]] - centre, axis=1)
        return out

    def _around(self, T_world_body: SE3, point: Ints) -> Ints:
        """Keyframes whose points make the local map: those that see what the frame sees, and where that is little,
        those that look from near its pose where it looks."""
        voting = local_keyframes(self.map, point, otherwise=-1) if np.any(point >= 0) else np.zeros(0, np.int32)
        if np.count_nonzero(point >= 0) >= ENOUGH_VOTES:
            return voting
        near = keyframes_near(self.map, T_world_body @ self.T_body_cam, NEAR_M, NEAR_DEG)[:NEAREST]
        around = np.concatenate([voting, near[~np.isin(near, voting)]]).astype(np.int32)
        return around if len(around) else np.zeros(1, np.int32)

    def _landmarks_of_frame(self, frame: Tracked, T_world_body: SE3) -> Landmarks:
        """The last frame's points of both kinds."""
        known = super()._landmarks_of_frame(frame, T_world_body)
        if frame.temporary is None or not len(self.temporary):
            return known
        carried = self.temporary.alive(frame.temporary)
        use = np.flatnonzero(carried >= 0)
        seen, carried = frame.seen.take(use), carried[use]
        return Landmarks(
            np.append(known.point, FIRST_TEMPORARY - carried).astype(np.int32),
            np.concatenate([known.xyz, self.temporary.table.xyz[carried]]),
            np.concatenate([known.desc, seen.desc]),
            np.append(known.octave, seen.octave),
            np.append(known.angle, seen.angle),
        )


def _is_open(tracked: Tracked) -> bool:
    """Whether the points whose distance is known leave open where the camera is."""
    sigma_m = math.sqrt(np.linalg.eigvalsh(tracked.covariance[3:, 3:])[-1])
    return tracked.measured < ENOUGH_MEASURED or sigma_m > OPEN_M


def _right(chi2: Array, inliers: Bools, window: float) -> int:
    """How many of the inliers are right, going by how many more there are than if none were.

    chi2 : (N,) of all matches by a sharp frame's noise; window : sigmas around its prediction in which each was found

    Wrong matches lie anywhere in their windows. Whatever the noise, right ones lie nearer the middle; so they are
    counted within the bounds of several noises, none of which leaves more to chance than half of the window.
    """
    most = 0.0
    for noise in NOISES:
        bound = CHI2_PX * noise**2
        chance = bound / window**2
        if chance < 0.5:
            most = max(most, (np.count_nonzero(chi2 <= bound) - chance * len(chi2)) / (INLIERS - chance))
    return min(round(most), int(np.count_nonzero(inliers)))


def n_temporary(tracked: Tracked) -> int:
    """Temporary points that agree with a frame's pose."""
    return 0 if tracked.temporary is None else int(np.count_nonzero(tracked.temporary >= 0))
