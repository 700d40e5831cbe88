"""From one frame's features to its pose: predict, match with the last frame, match with the local map, solve twice."""

from __future__ import annotations

import math

import numpy as np

from lodelight.estimation.factors.reprojection import CHI2_PX
from lodelight.estimation.pose import PoseResult, optimize_pose
from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex, consistent_turn, match_descriptors
from lodelight.features.orb import OrbConfig
from lodelight.features.shutter import STILL, Shutter
from lodelight.geometry.pnp import ransac_pnp
from lodelight.geometry.se3 import SE3
from lodelight.localization.motion import Motion
from lodelight.localization.tracked import Fit, Landmarks, Tracked, TrackerConfig
from lodelight.mapping.map import Map
from lodelight.mapping.sight import Sight, in_sight, local_keyframes, points_of_keyframes
from lodelight.rig import Rig
from lodelight.types import AnyArray, Array, Bools, Ints, Words

__all__ = ["Fit", "Landmarks", "Tracked", "Tracker", "TrackerConfig"]

MAX_DEPTH_RATIO = 0.5  # a prediction of where things are is not wrong by half of their depth
MIN_DEPTH_M = 0.1
CLOSE_SIGMA = 0.05  # of a depth, as a share of it, up to which a point is put there
MEDIAN_CHI2_2, MEDIAN_CHI2_3 = 1.386, 2.366  # of a chi-square distribution with 2 and 3 degrees of freedom
SHARP, MAX_NOISE = 1.25, 4.0  # a frame's noise over a sharp one's: below, it counts as sharp; more is a failure
INLIERS = 0.95  # of right matches, which pass their test
CHANCE_SIGMA = 3.0  # of the binomial distribution of those that agree by chance: so many are put down to it
UNROLLINGS, SETTLED_PX = 3, 1.0  # of a rolling shutter: at most so many, until rows are moved by less than that
NARROW, WIDE = 2.5, 4.0  # windows around points seen from where they were mapped, and from elsewhere
RADIAN_M = 3.0  # a turn by a radian takes as much out of view as this many metres
MAJORITY = 0.5  # of the matches: fewer that agree on a pose, and another may have more


class Tracker:
    """Follows the camera in a map that others write. Keeps only the last frame and the motion up to it."""

    def __init__(self, rig: Rig, map: Map, orb: OrbConfig, config: TrackerConfig, seed: int = 0) -> None:
        self.map = map
        self.orb = orb
        self.config = config
        self.seed = seed
        self.camera = rig.cameras[0].camera
        self.T_body_cam = rig.cameras[0].T_body_cam
        self.shutter = Shutter(rig.cameras[0])
        self.last: Tracked | None = None
        self._motion = Motion()

    # -- the loop's two calls -----------------------------------------------------------------------------------

    def track(self, t_ns: int, seen: Features) -> Tracked:
        """Pose of a frame that follows the last one; `why_lost` says what failed where it is not empty.

        Three ways to a first pose, each tried where the one before does not convince: the last frame's points near
        where the motion model puts them, the same by descriptor alone, and the reference keyframe's by descriptor.
        """
        assert self.last is not None
        last = self.last
        T_world_last = self._moved_with_map(last)
        dt_s = (t_ns - last.t_ns) * 1e-9
        predicted = T_world_last @ self._motion.over(dt_s)
        twist = self._motion.of_camera(self.T_body_cam).twist
        seen = self.shutter.straightened(seen, twist)
        index = FeatureIndex(seen, self.camera.width, self.camera.height)
        recent = self._landmarks_of_frame(last, T_world_last)
        pairs = self._match_predicted(recent, predicted, index)
        fit = self._fit(predicted, seen, recent, pairs, self.config.search_px)
        if not self._convincing(fit):
            for landmarks in (recent, self._landmarks_of_keyframe(last.reference)):
                pairs = self._match_blindly(landmarks, seen)
                fit = max(fit, self._fit(predicted, seen, landmarks, pairs, math.inf), key=lambda f: f.right)
                if self._convincing(fit):
                    break
        if fit.right < self.config.min_matches:
            return self._lost(t_ns, seen, predicted, f"{fit.solved.n_inliers} of {fit.tried} matches fit one pose")
        return self._settled(t_ns, seen, twist, fit, index)

    def refine(
        self, t_ns: int, seen: Features, T_world_body: SE3, point: Ints, index: FeatureIndex, search: float
    ) -> Tracked:
        """Match the local map around a pose that is nearly right, and solve again.

        point : (N,) matches so far; search : window in units of a corner's own scale
        """
        map, orb = self.map, self.orb
        reference = self.last.reference if self.last else 0
        voting = local_keyframes(map, point, otherwise=reference)
        local = points_of_keyframes(map, voting)
        sight = in_sight(map, local, T_world_body, self.T_body_cam, self.camera, orb)
        map.points.n_visible[sight.point] += 1
        point = self._matched(sight, map.points.desc[sight.point], point, point < 0, index, search)
        used = np.flatnonzero(point >= 0)
        solved, noise = self._solve(T_world_body, seen.take(used), map.points.xyz[point[used]])
        point[used[~solved.inliers]] = -1
        map.points.n_found[point[point >= 0]] += 1
        tracked = Tracked(t_ns, seen, solved.T_world_body, solved.covariance, point, int(voting[0]), noise=noise)
        if tracked.n_inliers < self.config.min_inliers:
            tracked.why_lost = f"{tracked.n_inliers} of {len(used)} matches with the local map are inliers"
        return tracked

    def track_at(self, t_ns: int, seen: Features, T_world_body: SE3) -> Tracked:
        """Pose of a frame of which something else says where it was taken, to within what a search window forgives.

        Matched with the keyframe that looks most alike from there, and with nothing the last frames believed.
        """
        keyframe = self._keyframe_near(T_world_body)
        index = FeatureIndex(seen, self.camera.width, self.camera.height)
        landmarks = self._landmarks_of_keyframe(keyframe)
        pairs = self._match_predicted(landmarks, T_world_body, index)
        fit = self._fit(T_world_body, seen, landmarks, pairs, self.config.search_px)
        if fit.right < self.config.min_matches:
            return self._lost(t_ns, seen, T_world_body, f"{fit.solved.n_inliers} of {fit.tried} matches fit there")
        return self._settled(t_ns, seen, STILL, fit, index)

    def accept(self, tracked: Tracked) -> None:
        """Make this the last frame."""
        known = self.last is not None and not self.last.why_lost and not tracked.why_lost
        self._motion = self._moving(tracked.t_ns, tracked.T_world_body, tracked.covariance) if known else Motion()
        tracked.T_reference_body = self.map.pose(tracked.reference).inverse() @ tracked.T_world_body
        self.last = tracked

    # -- parts --------------------------------------------------------------------------------------------------

    def _matched(self, sight: Sight, desc: Words, point: Ints, free: Bools, index: FeatureIndex, search: float) -> Ints:
        """`point` (N,) with those in sight added that were found near where they should be.

        desc : (M, 4) of the points in sight; free : (N,) features that may be taken; search : window in units of a
        corner's own scale
        """
        new = ~np.isin(sight.point, point[point >= 0])
        octave = sight.octave[new]
        radius = np.where(sight.cosine[new] > 0.998, NARROW, WIDE) * search * self.orb.scale(octave)
        match = index.search(sight.px[new], radius, (octave - 1, octave + 1), desc[new], free=free, ratio=0.8)
        point = point.copy()
        point[match[match >= 0]] = sight.point[new][match >= 0]
        return point

    def _settled(self, t_ns: int, seen: Features, twist: Array, fit: Fit, index: FeatureIndex) -> Tracked:
        """From a first pose to the last one. twist : by which `seen` was straightened"""
        T_world_body = fit.solved.T_world_body
        if self.shutter.rolls:
            seen, T_world_body = self._unrolled(t_ns, seen, twist, fit)
            index = FeatureIndex(seen, self.camera.width, self.camera.height)
        return self.refine(t_ns, seen, T_world_body, fit.point, index, search=3.0)

    def _unrolled(self, t_ns: int, seen: Features, twist: Array, fit: Fit) -> tuple[Features, SE3]:
        """A frame of a rolling shutter straightened by how the camera moves, and by the turn that its own rows show
        beyond that; and its pose. twist : by which `seen` was straightened so far"""
        used, solved, noise = np.flatnonzero(fit.point >= 0), fit.solved, 1.0
        for _ in range(UNROLLINGS):
            if len(used) < self.config.min_matches:
                break
            xyz = self.map.points.xyz[fit.point[used]]
            xyz_cam = (solved.T_world_body @ self.T_body_cam).inverse() @ xyz
            moving = self._moving(t_ns, solved.T_world_body, solved.covariance).of_camera(self.T_body_cam)
            more = moving.twist - twist
            more[:3] = self.shutter.turn_left_over(
                seen.px[used], noise * self._sigma_px(seen.take(used)), xyz_cam,
                more[:3], moving.later(0.5 * self.shutter.readout_s).covariance[:3, :3],
            )  # fmt: skip
            seen, twist = self.shutter.straightened(seen, more), twist + more
            solved, noise = self._solve(solved.T_world_body, seen.take(used), xyz)
            used = used[solved.inliers]
            if self.shutter.reach_px(more) < SETTLED_PX:
                break
        return seen, solved.T_world_body

    def _moving(self, t_ns: int, T_world_body: SE3, covariance: Array) -> Motion:
        """The motion of a body that is at T_world_body now, going by that and by how it moved before."""
        last = self.last
        if last is None or last.why_lost or t_ns <= last.t_ns:
            return Motion()
        dt_s = (t_ns - last.t_ns) * 1e-9
        before = self._moved_with_map(last)
        return self._motion.later(dt_s).measured(before, last.covariance, T_world_body, covariance, dt_s)

    def _moved_with_map(self, frame: Tracked) -> SE3:
        """T_world_body of a past frame, as its reference keyframe has been corrected since."""
        return self.map.pose(frame.reference) @ frame.T_reference_body

    def _keyframe_near(self, T_world_body: SE3) -> int:
        """The one that is nearest, a radian of turn counting as much as RADIAN_M."""
        kf, alive = self.map.keyframes, self.map.alive_keyframes
        chord = np.linalg.norm(kf.R[alive] - T_world_body.R, axis=(1, 2)) / math.sqrt(2.0)  # 2 sin(angle / 2)
        away = np.linalg.norm(kf.p[alive] - T_world_body.t, axis=1) + RADIAN_M * chord
        return int(alive[np.argmin(away)])

    def _landmarks_of_frame(self, frame: Tracked, T_world_body: SE3) -> Landmarks:
        """What a frame saw: its map points, and features with a depth but no map point, put where that depth says."""
        seen = frame.seen
        point = self.map.surviving(frame.point)
        use = np.flatnonzero((point >= 0) | (seen.sigma_inv_depth < CLOSE_SIGMA * seen.inv_depth))
        seen, point = seen.take(use), point[use]
        depth = 1.0 / np.where(seen.inv_depth > 0, seen.inv_depth, 1.0)
        xyz = (T_world_body @ self.T_body_cam) @ (seen.ray * (depth / seen.ray[:, 2])[:, None])
        xyz[point >= 0] = self.map.points.xyz[point[point >= 0]]
        return Landmarks(point, xyz, seen.desc, seen.octave, seen.angle)

    def _landmarks_of_keyframe(self, keyframe: int) -> Landmarks:
        seen, point = self.map.features_of(keyframe), self.map.points_of(keyframe)
        use = np.flatnonzero(point >= 0)
        seen, point = seen.take(use), point[use]
        return Landmarks(point, self.map.points.xyz[point], seen.desc, seen.octave, seen.angle)

    def _match_predicted(self, landmarks: Landmarks, predicted: SE3, index: FeatureIndex) -> Ints:
        """(M, 2) rows (landmark, feature): nearest descriptors around where the landmarks should appear."""
        px, inside = self.camera.project((predicted @ self.T_body_cam).inverse() @ landmarks.xyz)
        use = np.flatnonzero(inside)
        octave = landmarks.octave[use]
        radius = self.config.search_px * self.orb.scale(octave)
        match = index.search(px[use], radius, (octave - 1, octave + 1), landmarks.desc[use], ratio=0.9)
        return _pairs(use, match, landmarks, index.features)

    def _match_blindly(self, landmarks: Landmarks, seen: Features) -> Ints:
        """(M, 2) rows (landmark, feature) by descriptors alone."""
        match = match_descriptors(landmarks.desc, seen.desc, max_hamming=64, ratio=0.8)
        return _pairs(np.arange(len(landmarks.point)), match, landmarks, seen)

    def _fit(self, start: SE3, seen: Features, landmarks: Landmarks, pairs: Ints, search_px: float) -> Fit:
        """The pose that most of the pairs agree with, looked for around `start`, then from random samples of them.

        Around a prediction that is far off, wrong matches are the nearest: they hold a local optimization there.
        search_px : how far from where `start` puts them they were looked for, at the finest octave
        """
        feature, xyz = seen.take(pairs[:, 1]), landmarks.xyz[pairs[:, 0]]
        solved, noise = self._solve(start, feature, xyz)
        right = self._right(solved, noise, search_px)
        if right < MAJORITY * len(pairs):
            drawn = ransac_pnp(feature.ray, xyz, self._sigma_px(feature) / self.camera.focal_px, self.seed)
            if drawn is not None:
                other, other_noise = self._solve(drawn[0] @ self.T_body_cam.inverse(), feature, xyz)
                other_right = self._right(other, other_noise, search_px)
                if other_right / other_noise > right / noise:
                    solved, noise, right = other, other_noise, other_right
        agreed = pairs[solved.inliers]
        point = np.full(len(seen), -1, np.int32)
        point[agreed[:, 1]] = landmarks.point[agreed[:, 0]]
        return Fit(solved, point, len(pairs), right)

    def _convincing(self, fit: Fit) -> bool:
        return fit.right >= max(self.config.min_matches, MAJORITY * fit.tried)

    def _right(self, solved: PoseResult, noise: float, search_px: float) -> float:
        """How many matches are right at least, going by how many more are inliers than would be if none were.

        A wrong match lies anywhere in the window it was looked for in, so it passes for an inlier as often as the
        bound's share of that window is large. Where a frame is noisy, that is often: there a wrong pose gathers as
        many inliers in its windows as the right one, and only matches from the whole image tell them apart.
        """
        chance = min(CHI2_PX * (noise * self.config.sigma_px / search_px) ** 2, INLIERS)
        n = len(solved.inliers)
        excess = solved.n_inliers - chance * n - CHANCE_SIGMA * math.sqrt(chance * (1.0 - chance) * n)
        return max(excess, 0.0) / (INLIERS - chance) if chance < INLIERS else 0.0

    def _solve(
        self, start: SE3, seen: Features, xyz: Array, weight: Array | float = 1.0, spread: Array | float = 0.0,
        prior: tuple[SE3, Array] | None = None,
    ) -> tuple[PoseResult, float]:  # fmt: skip
        """Motion-only optimization of features against world positions (N, 3), and by how much this frame's noise
        exceeds a sharp one's.

        spread : (N,) px by which a position may be off, beside the noise of its corner; prior : as in `optimize_pose`
        Pairs of which the start already says that one is much farther than the other are put out of reach first: a
        wrong match close to the camera has a hold on the pose that no robust kernel takes from it.
        A blurred or quickly turning camera measures worse than its calibration says. Tested against the noise of a
        sharp frame, the few matches that pass would agree by chance: the frame's own median says what to expect.
        """
        z = ((start @ self.T_body_cam).inverse() @ xyz)[:, 2]
        unlike = (seen.inv_depth > 0) & (np.abs(z * seen.inv_depth - 1.0) > MAX_DEPTH_RATIO)
        possible = ~(unlike | (z < MIN_DEPTH_M))
        information = np.where(possible, weight, 0.0)
        noise = 1.0
        for _ in range(2):
            solved = optimize_pose(
                start, self.T_body_cam, self.camera, xyz, seen.px,
                np.hypot(noise * self._sigma_px(seen), spread), seen.inv_depth, noise * seen.sigma_inv_depth,
                information_weight=information, prior=prior,
            )  # fmt: skip
            expected = np.where(seen.inv_depth > 0, MEDIAN_CHI2_3, MEDIAN_CHI2_2)
            excess = np.median((solved.chi2 / expected)[possible]) if possible.any() else 1.0
            noise = float(np.clip(noise * math.sqrt(excess), 1.0, MAX_NOISE))
            if noise < SHARP:
                return solved, 1.0
        return solved, noise

    def _sigma_px(self, seen: Features) -> Array:
        return self.config.sigma_px * self.orb.scale(seen.octave)

    def _lost(self, t_ns: int, seen: Features, T_world_body: SE3, why: str) -> Tracked:
        nothing = np.full(len(seen), -1, np.int32)
        reference = self.last.reference if self.last else 0
        return Tracked(t_ns, seen, T_world_body, np.diag([1.0] * 6), nothing, reference, why_lost=why)


def _pairs(rows: AnyArray, match: Ints, landmarks: Landmarks, seen: Features) -> Ints:
    """(M, 2) of (landmark, feature) from a search's answer for `rows`, those kept whose patches turn alike."""
    hit = np.flatnonzero(match >= 0)
    hit = hit[consistent_turn(landmarks.angle[rows[hit]], seen.angle[match[hit]])]
    return np.stack([rows[hit], match[hit]], axis=1).astype(np.int32)
