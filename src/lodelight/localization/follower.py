"""Follows a camera in the current map: the points of the map around it, which nobody writes, and temporary points.

While a frame is matched, one array says what each feature is: a map point p as p, a temporary point t as -2 - t,
nothing as -1. What the map reads of it takes every negative number for nothing, so no temporary point can be taken
for one of the map's. A finished `Tracked` has the two kinds apart.
"""

from __future__ import annotations

import numpy as np

from lodelight.estimation.pose import PoseResult
from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.localization.influence import MOST, leverage
from lodelight.localization.motion import Motion
from lodelight.localization.temporary import TemporaryPoints
from lodelight.localization.tracker import Landmarks, Tracked, Tracker, TrackerConfig
from lodelight.mapping.map import Map
from lodelight.mapping.sight import in_sight, keyframes_near, local_keyframes, points_of_keyframes
from lodelight.rig import Rig
from lodelight.types import Array, Ints

FIRST_TEMPORARY = -2
ENOUGH_VOTES = 30  # matches with the map, from which its own covisibility says best what is around
MOST_DECIDING = 5  # points that decide a pose alone, in one frame
NEAR_M, NEAR_DEG, NEAREST = 8.0, 60.0, 20  # else keyframes from so near, turned by so little, at most so many


class Follower(Tracker):
    """A tracker that leaves the map as it is. temporary : the overlay, empty while the map is enough"""

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

    def forget(self) -> None:
        """The camera may be anywhere now."""
        self.last = None
        self._motion = Motion()

    def forget_temporary(self) -> None:
        """Clear the overlay, and the last frame's matches with it."""
        self.temporary.clear()
        if self.last is not None:
            self.last.temporary = None

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
        """
        map = self.map
        voting = self._around(T_world_body, point)
        sight = in_sight(map, points_of_keyframes(map, voting), T_world_body, self.T_body_cam, self.camera, self.orb)
        mapped = np.where(point >= 0, point, -1).astype(np.int32)
        mapped = self._matched(sight, map.points.desc[sight.point], mapped, mapped < 0, index, search)
        carried = np.where((point <= FIRST_TEMPORARY) & (mapped < 0), FIRST_TEMPORARY - point, -1).astype(np.int32)
        overlay = self.temporary.table
        use_overlay = not map_alone and len(overlay) > 0
        if map_alone:
            carried[:] = -1
        if use_overlay:
            around = self.temporary.in_sight(T_world_body)
            free = (mapped < 0) & (carried < 0)
            carried = self._matched(around, overlay.desc[around.point], carried, free, index, search)
        used = np.flatnonzero((mapped >= 0) | (carried >= 0))
        of_map = mapped[used] >= 0
        xyz = np.empty((len(used), 3))
        xyz[of_map] = map.points.xyz[mapped[used[of_map]]]
        xyz[~of_map] = overlay.xyz[carried[used[~of_map]]]
        weight = np.where(of_map, 1.0, self.temporary.config.weight)
        spread, prior = np.zeros(len(used)), None
        if not of_map.all():
            centre = (T_world_body @ self.T_body_cam).t
            spread[~of_map] = self.camera.focal_px * self.temporary.uncertainty(carried[used[~of_map]], centre)
            prior = self._expected(t_ns)
        solved, noise = self._solve_without_leverage(T_world_body, seen.take(used), xyz, weight, spread, prior)
        wrong = used[~solved.inliers]
        mapped[wrong], carried[wrong] = -1, -1
        if use_overlay:
            self.temporary.count(around.point, carried[carried >= 0])
            carried = self.temporary.alive(carried)
        tracked = Tracked(
            t_ns, seen, solved.T_world_body, solved.covariance, mapped, int(voting[0]), noise, temporary=carried
        )
        if solved.n_inliers < self.config.min_inliers:
            tracked.why_lost = f"{solved.n_inliers} of {len(used)} matches with the local map are inliers"
        return tracked

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


def n_temporary(tracked: Tracked) -> int:
    """Temporary points that agree with a frame's pose."""
    return 0 if tracked.temporary is None else int(np.count_nonzero(tracked.temporary >= 0))
