"""The inertial half of the SLAM system: odometry in front, the map behind it.

The odometry's frame is `map`: smooth. The map's is `world`: corrected by loops and by what was known before. Between
them lies T_world_map, a turn about the vertical and a shift; what a robot drives by is smooth, what it plans with is
right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import Stopwatch
from lodelight.estimation.inertial_bundle import ImuChain
from lodelight.estimation.window import Landmarks, Window
from lodelight.features.features import Features
from lodelight.features.frontend import FrontEnd
from lodelight.features.klt import Tracks
from lodelight.features.matching import FeatureIndex
from lodelight.geometry.se3 import SE3, level
from lodelight.localization.berth import Berth
from lodelight.localization.machine import Finder
from lodelight.localization.tracker import Tracked, Tracker
from lodelight.mapping.compact import squeeze
from lodelight.mapping.keyframes import Candidate, Decision, Gate, gated
from lodelight.mapping.light_anchor import LightAnchor
from lodelight.mapping.local import LocalMapper
from lodelight.mapping.map import Map
from lodelight.mapping.places import Places
from lodelight.messages import LOST_COVARIANCE, Estimate, Frame, Imu, TagSighting
from lodelight.odometry.flown import Flown
from lodelight.odometry.inertial import InertialOdometry, OdometryStep
from lodelight.tags.gate import KnownTag
from lodelight.types import Array, Bools, Ints

EventSink = Callable[..., None]
NEAR_TRACK_PX = 1.5  # a corner so near a track is the same point
DEPTH_SIGMA = 0.02  # least relative deviation of a depth that the window gives a corner
SEARCH = 2.0  # window in which map points are looked for around the odometry's pose, of a corner's own scale
MIN_MATCHES = 20  # of map points, below which they do not tell a keyframe's place in the map
DEAD, DEAD_ROWS = 0.25, 20_000  # share of the map's features, and how many, that are worth numbering the map anew
LOST_KEYFRAMES = 3  # not found where they should be in a map that is only read: look for the next one everywhere


@dataclass(frozen=True, eq=False)
class Located:
    """One frame: its estimate, and where it hangs: reference is a keyframe of the map, -1 where there is none.

    keyframe : what `InertialFront.insert` makes a keyframe of, None where it becomes none
    tags : that were seen in it
    """

    frame: Frame
    estimate: Estimate
    reference: int
    T_reference_body: SE3
    keyframe: NewKeyframe | None = None
    tags: tuple[TagSighting, ...] = ()


@dataclass(frozen=True, eq=False)
class NewKeyframe:
    """A keyframe of the window that may become one of the map; landmarks : of the window at the time."""

    step: OdometryStep
    landmarks: Landmarks


class InertialFront:
    """Drives the odometry, and puts its keyframes into the map."""

    def __init__(
        self, odometry: InertialOdometry, map: Map, front_end: FrontEnd, tracker: Tracker, mapper: LocalMapper,
        find: Finder, emit: EventSink, see: Callable[[Frame], Sequence[TagSighting]] = lambda frame: (),
        gates: tuple[Gate, ...] = (), lights: LightAnchor | None = None,
    ) -> None:  # fmt: skip
        """see : finds the tags in a frame; gates : that a keyframe of the window must pass to become one of the map
        lights : told where the body is
        """
        self.odometry = odometry
        self.map = map
        self.front_end = front_end
        self.tracker = tracker
        self.mapper = mapper
        self.find = find
        self.emit = emit
        self.see = see
        self.gates = gates
        self.lights = lights
        self.localization_only = False
        self.relocalizations = 0
        self._known = len(map.points)  # of a map that the camera must first be found in
        self._berth = Berth(map)
        self._missed = 0  # keyframes in a row that a map that is only read did not show
        self._hung_ns = -1  # the last one that it did show
        self._reference = -1
        self._T_map_reference = SE3.identity()
        self.flown = Flown()
        self._window: Window | None = None  # that the last frame was in
        mapper.hold_poses = True  # the window has placed them, with the IMU

    def feed(self, message: Imu | Frame) -> Located | None:
        """One message; where it completes a frame, that frame."""
        clock = Stopwatch()
        if isinstance(message, Frame):
            step = self.odometry.feed_frame(message, self.see(message))
        else:
            step = self.odometry.feed_imu(message)
        return None if step is None else self._located(step, clock)

    def flush(self) -> Located | None:
        """The last frame, which may still wait for a sample."""
        clock = Stopwatch()
        step = self.odometry.flush()
        return None if step is None else self._located(step, clock)

    def tie(self, known: Mapping[str, KnownTag], again: bool = False) -> None:
        """See `InertialOdometry.tie`; the tags are given in the map's frame."""
        if self.odometry.tie(known, again):
            self._tied()

    def _tied(self) -> None:
        """The odometry's frame is the map's, as surveyed tags have it."""
        if self._reference >= 0:
            self._T_map_reference = self.map.pose(self._reference)

    @property
    def T_world_map(self) -> SE3:
        """Where the smooth frame lies in the corrected one, as the map stands now."""
        if self._reference < 0:
            return SE3.identity()
        return level(self.map.pose(self._reference) @ self._T_map_reference.inverse(), self._T_map_reference.t)

    # -- parts --------------------------------------------------------------------------------------------------

    def _located(self, step: OdometryStep, clock: Stopwatch) -> Located:
        t_ns = step.frame.t_ns
        if self._window is not None and self.odometry.window is not self._window:
            self._leave(self._window)
        self._window = self.odometry.window
        if step.status not in ("tracking", "degraded"):
            return self._nowhere(step, clock)
        new = None
        if step.keyframe:
            assert self.odometry.window is not None
            new = NewKeyframe(step, self.odometry.window.landmarks())
        with self.map.lock:
            self._settle_departed()
            if step.tied:
                self._tied()
            if self._reference < 0 and self._known and step.keyframe:
                self._find(step, self.front_end.process(step.frame))
            if self._reference < 0 and (self._known or self.localization_only or new is None):
                return self._nowhere(step, clock, "not found in the map yet")
            reference, T_world_map = self._reference, self.T_world_map
            T_world_body = T_world_map @ step.state.T_world_body
            T_reference_body = self._T_map_reference.inverse() @ step.state.T_world_body
            if self.lights and reference >= 0:
                self.lights.tracked(t_ns, reference, T_reference_body)
        covariance = step.covariance[:6, :6].copy()
        turn = np.eye(6)
        turn[3:, 3:] = T_world_map.R
        details = {"track_ms": clock.ms(), **_motion(step, T_world_map)}
        estimate = Estimate(
            t_ns, step.status, T_world_body, turn @ covariance @ turn.T, step.why, step.inliers, details
        )  # fmt: skip
        return Located(step.frame, estimate, reference, T_reference_body, new, step.tags)

    def _nowhere(self, step: OdometryStep, clock: Stopwatch, why: str = "") -> Located:
        T = self.T_world_map @ step.state.T_world_body
        status = step.status if step.status in ("initializing", "lost") else "initializing"
        details = {"track_ms": clock.ms()}
        estimate = Estimate(step.frame.t_ns, status, T, LOST_COVARIANCE, why or step.why, 0, details)
        return Located(step.frame, estimate, -1, SE3.identity())

    def _find(self, step: OdometryStep, seen: Features) -> None:
        """Look for a keyframe of the window everywhere in the map."""
        found = self.find(seen)
        if isinstance(found, str):
            return
        reference = int(np.argmax(self.map.shared_counts(found.point[found.point >= 0])))
        self._berth.forget()
        self._hang(step, Tracked(step.frame.t_ns, seen, found.T_world_body, found.covariance, found.point, reference))
        self.relocalizations += 1
        self.emit(step.frame.t_ns, "relocalized", why=found.why)

    def _look_up(self, step: OdometryStep, seen: Features) -> None:
        """Where a keyframe of the window lies in a map that does not come of it: that moves the whole smooth frame."""
        if step.restarted or self._missed >= LOST_KEYFRAMES:
            self._find(step, seen)
            return
        known = len(self.map.points) if self.localization_only else self._known
        tracked = self.tracker.track_at(step.frame.t_ns, seen, self.T_world_map @ step.state.T_world_body)
        theirs = int(np.count_nonzero((tracked.point >= 0) & (tracked.point < known)))
        if tracked.why_lost or theirs < max(MIN_MATCHES, tracked.n_inliers // 2):
            self._missed += self.localization_only
        else:
            self._hang(step, tracked)

    def _hang(self, step: OdometryStep, tracked: Tracked) -> None:
        """Hold the odometry's frame to where a keyframe of the window was found in the map."""
        self._missed, self._hung_ns = 0, step.frame.t_ns
        self.tracker.accept(tracked)
        T_world_map = self._berth.add(step.state.T_world_body, tracked.reference, tracked.T_reference_body)
        self._reference = tracked.reference
        self._T_map_reference = T_world_map.inverse() @ self.map.pose(self._reference)

    def insert(self, new: NewKeyframe) -> tuple[int, Decision]:
        """A keyframe of the window becomes one of the map, and the reference of the frames that follow, if the gates
        let it; its number, or -1.

        What takes long in it the next frame need not wait for: from the thread that maps.
        """
        step = new.step
        seen = self.front_end.process(step.frame)
        if (self._known or self.localization_only) and self._hung_ns != step.frame.t_ns:
            with self.map.lock:
                self._look_up(step, seen)
        if self.localization_only:
            return -1, Decision(False, "localization only")
        if not (seen.inv_depth > 0).any():
            seen = with_landmark_depth(seen, step.tracks, new.landmarks, self._T_map_cam(step))
        with self.map.lock:
            return self._insert(step, seen)

    def _insert(self, step: OdometryStep, seen: Features) -> tuple[int, Decision]:
        T_world_body = self.T_world_map @ step.state.T_world_body
        nothing = np.full(len(seen), -1, np.int32)
        tracked = Tracked(
            step.frame.t_ns, seen, T_world_body, step.covariance[:6, :6], nothing, max(self._reference, 0)
        )
        decision = Decision(True, "")
        if self._reference >= 0:
            index = FeatureIndex(seen, self.tracker.camera.width, self.tracker.camera.height)
            matched = self.tracker.refine(step.frame.t_ns, seen, T_world_body, nothing, index, SEARCH)
            decision = gated(self._candidate(step, T_world_body, matched), self.gates)
            if not decision.insert:
                return -1, decision
            if matched.n_inliers >= MIN_MATCHES:
                tracked.point = matched.point
        keyframe = self.mapper.insert(
            step.frame.t_ns, T_world_body, seen, tracked.point, decision.weight, self._reference, tracked.noise
        )  # fmt: skip
        self.map.keyframes.covariance[keyframe] = step.covariance[:6, :6]
        tracked.point[:] = self.map.points_of(keyframe)
        tracked.reference = keyframe
        self.tracker.accept(tracked)
        if self.lights:
            self.lights.inserted(keyframe, step.frame.t_ns)
        self._reference, self._T_map_reference = keyframe, step.state.T_world_body
        self.flown.number[step.frame.t_ns] = keyframe
        return keyframe, decision

    def squeeze(self, places: Places) -> None:
        """Give back the room of what is dead in the map, once it is a quarter of it. From the thread that maps, which
        alone keeps numbers of points from one frame to another."""
        map = self.map
        with map.lock:
            alive = map.keyframes.alive
            dead = len(map.features) - int(map.keyframes.n_features[alive].sum())
            if dead < max(DEAD * len(map.features), DEAD_ROWS):
                return
            places.follow()  # it asks dead keyframes for their features once more
            last = self.tracker.last
            if last is not None:
                last.point[:] = map.surviving(last.point)
            new_point = squeeze(map)
            if last is not None:
                last.point[:] = new_point[last.point]
            self._known = int(np.count_nonzero(new_point[: self._known] >= 0))
            self.mapper.renumber(new_point)
            self.flown.thin(alive, max(self.flown.number, default=0))

    def _candidate(self, step: OdometryStep, T_world_body: SE3, matched: Tracked) -> Candidate:
        """What gates ask about; the window has decided that there should be a keyframe."""
        expected = self.map.points_of(self._reference)
        confirmed = int(np.count_nonzero(self.map.points.n_obs[expected[expected >= 0]] >= 2))
        return Candidate(
            t_ns=step.frame.t_ns, inliers=matched.n_inliers, reference_points=max(confirmed, 1), close_tracked=0,
            close_untracked=0, n_keyframes=len(self.map.keyframes), noise=1.0, since_keyframe_s=0.0,
            since_relocalization_s=0.0, T_world_body=T_world_body, covariance=step.covariance[:6, :6],
        )  # fmt: skip

    def _T_map_cam(self, step: OdometryStep) -> SE3:
        return step.state.T_world_body @ self.map.rig.cameras[0].T_body_cam

    def _settle_departed(self) -> None:
        """Keyframes that left the window stay where it saw them last."""
        window = self.odometry.window
        if window is None:
            return
        T_world_map = self.T_world_map
        for gone in window.departed():
            keyframe = self.flown.number.get(gone.t_ns, -1)
            self.flown.add(gone.state, gone.imu, self.odometry.spec, gone.still)
            if keyframe >= 0 and keyframe != self._reference and self.map.keyframes.alive[keyframe]:
                self.map.set_pose(keyframe, T_world_map @ gone.state.T_world_body)

    def chain(self, keyframes: Ints, R: Array) -> ImuChain | None:
        """The IMU between these keyframes of the map (K,), whose rotations are (K, 3, 3); None where there is none."""
        if self._window is not None:
            self._leave(self._window)
            self._window = None
        return self.flown.chain(keyframes, R)

    def _leave(self, window: Window) -> None:
        """A window that ends: its keyframes have flown."""
        for gone in window.departed():
            self.flown.add(gone.state, gone.imu, self.odometry.spec, gone.still)
        frames = [frame for frame in window.frames if frame.keyframe]
        for frame, after in zip(frames, [*frames[1:], None], strict=True):
            imu = after.imu.samples if after is not None and after.imu is not None else None
            self.flown.add(frame.state, imu, self.odometry.spec, frame.still_sigma > 0.0)


def with_landmark_depth(seen: Features, tracks: Tracks, landmarks: Landmarks, T_map_cam: SE3) -> Features:
    """Corners that lie on a track of the window get the depth of its landmark."""
    _, row, landmark = np.intersect1d(tracks.id, landmarks.track, assume_unique=True, return_indices=True)
    z = (T_map_cam.inverse() @ landmarks.xyz[landmark])[:, 2]
    relative = landmarks.sigma_inv_depth[landmark] / np.maximum(landmarks.inv_depth[landmark], 1e-6)
    good: Bools = (z > 0.1) & (landmarks.seen[landmark] >= 3) & (relative < 0.2)
    px, z, relative = tracks.px[row[good]], z[good], np.maximum(2.0 * relative[good], DEPTH_SIGMA)
    inv_depth, sigma = np.zeros(len(seen), np.float32), np.zeros(len(seen), np.float32)
    if len(px):
        away = np.linalg.norm(seen.px[:, None, :] - px[None, :, :], axis=2)
        nearest = away.argmin(axis=1)
        hit = np.flatnonzero(away[np.arange(len(seen)), nearest] < NEAR_TRACK_PX)
        inv_depth[hit] = 1.0 / z[nearest[hit]]
        sigma[hit] = relative[nearest[hit]] * inv_depth[hit]
    return seen.with_depth(inv_depth, sigma)


def _motion(step: OdometryStep, T_world_map: SE3) -> dict[str, float]:
    """Velocity, m/s, world; biases, rad/s and m/s^2, and their standard deviations."""
    names = [f"{kind}_{axis}" for kind in ("velocity", "bias_gyro", "bias_accel") for axis in "xyz"]
    velocity, sigma = T_world_map.R @ step.state.v_world, np.sqrt(np.diag(step.covariance)[9:])
    values: Array = np.concatenate([velocity, step.state.bias_gyro, step.state.bias_accel])
    told = dict(zip(names, values.tolist(), strict=True))
    return told | {f"sigma_{name}": s for name, s in zip(names[3:], sigma.tolist(), strict=True)}
