"""The sliding window: the newest keyframes and the newest frame, with everything that was measured in and between them.

Levenberg-Marquardt over poses, velocities and biases; landmarks of inverse depth are eliminated one by one; what leaves
the window stays as a prior with first-estimate Jacobians. Frames come by `add_frame`; `solve` makes the estimate. A
frame that is no keyframe is the window's tail: when the next one comes, what was seen in it is dropped and its IMU
samples join the next. A keyframe too many, and the oldest leaves. Derivation: docs/derivations-inertial.md; science
note C1 to C6.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from lodelight.errors import CalibrationError
from lodelight.estimation.marginalization import Key, Prior
from lodelight.estimation.window_build import build, store
from lodelight.estimation.window_frames import Seen, SeenTag, WindowFrame, moved_row, pose_of, pose_row, row_of
from lodelight.estimation.window_leave import forget_tags, marginalize_oldest
from lodelight.estimation.window_problem import CONVERGED_CHI2, SETTLED_CHI2, Belief, Problem
from lodelight.estimation.window_tags import TagStates, inverse
from lodelight.estimation.window_types import (
    Departed,
    Landmarks,
    Observations,
    Solution,
    StartSigma,
    Tag,
    TagView,
    WindowConfig,
)
from lodelight.geometry.se3 import SE3, level
from lodelight.imu.preintegration import NavState, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec, Rig
from lodelight.types import AnyArray, Array

__all__ = [
    "Departed", "Landmarks", "Observations", "Solution", "StartSigma", "Tag", "TagView", "Window", "WindowConfig",
]  # fmt: skip

CARRY_RAD = 2e-4  # of yaw between the window and what its prior is linearized about; the square of it is nothing


class Window:
    """See the top of the file. Frame of all poses: z up, gravity (0, 0, -9.81)."""

    def __init__(self, rig: Rig, config: WindowConfig | None = None, imu_spec: ImuSpec | None = None) -> None:
        """All cameras of the rig may be observed. Raises CalibrationError on a rig without IMU."""
        self.config = config or WindowConfig()
        spec = imu_spec or rig.imu
        if spec is None:
            raise CalibrationError("the rig has no IMU; give its noise in the rig's [imu], or run without -inertial")
        k = self.config.imu_noise_scale
        self.spec = replace(
            spec, gyro_noise=k * spec.gyro_noise, accel_noise=k * spec.accel_noise,
            gyro_walk=k * spec.gyro_walk, accel_walk=k * spec.accel_walk,
        )  # fmt: skip
        self.cameras = rig.cameras
        self.mounts = np.array([pose_row(c.T_body_cam) for c in rig.cameras])
        self.offset_s = np.zeros(1)
        self.mounts_lin: Array | None = None
        self.offset_lin: Array | None = None
        self.beliefs: dict[Key, Belief] = {}
        if self.config.calibrate in ("extrinsics", "both"):
            sigma = np.repeat([self.config.mount_sigma_rad, self.config.mount_sigma_m], 3)
            for c, row in enumerate(self.mounts):
                self.beliefs["mount", c] = Belief(row.copy(), np.diag(sigma**-2.0))
        if self.config.calibrate in ("time", "both"):
            self.beliefs["offset", 0] = Belief(np.zeros(1), np.array([[self.config.offset_sigma_s**-2.0]]))
        self.frames: list[WindowFrame] = []
        self.prior = Prior()
        self.tag_states = TagStates()
        self.landmark_track: AnyArray = np.zeros(0, np.int64)
        self.landmark_world = np.zeros((0, 4))  # homogeneous
        self.landmark_sigma = np.zeros(0)
        self.landmark_seen = np.zeros(0, np.int32)
        self.landmark_inv_depth = np.zeros(0)
        self._departed: list[Departed] = []
        self._problem: Problem | None = None
        self._covariance: Array | None = None
        self._next_key = 0

    # -- what comes in

    def start(
        self,
        state: NavState,
        sigma: StartSigma,
        observations: Observations,
        tags: Sequence[TagView] = (),
        standstill: bool = False,
    ) -> None:
        """The first frame, a keyframe, with what is known of its state. The window must be new.

        standstill : its velocity is zero
        """
        if self.frames:
            raise RuntimeError("the window has started already; make a new one")
        R = state.T_world_body.R
        information = np.zeros((15, 15))
        information[:3, :3] = R.T @ np.diag(np.array([sigma.tilt_rad, sigma.tilt_rad, sigma.yaw_rad]) ** -2.0) @ R
        rest = [sigma.position_m, sigma.velocity_m_s, sigma.bias_gyro, sigma.bias_accel]
        information[3:, 3:] = np.diag(np.repeat(rest, 3) ** -2.0)
        frame = self._frame(state, True, observations, tags)
        frame.still_sigma = self.config.still_sigma_m_s if standstill else 0.0
        self.beliefs["frame", frame.key] = Belief(frame.x.copy(), information)

    def add_frame(
        self,
        t_ns: int,
        imu: ImuSamples,
        observations: Observations,
        tags: Sequence[TagView] = (),
        keyframe: bool = False,
        standstill: bool = False,
        guess: NavState | None = None,
    ) -> None:
        """A frame later than all before.

        imu : covers the time since the newest frame; standstill : its velocity is zero
        guess : its state; default what the IMU predicts
        Raises SourceError where the IMU does not cover the time.
        """
        last = self.frames[-1]
        samples = imu.between(last.t_ns, t_ns)
        state = guess
        if state is None:
            state = last.state.predicted(preintegrate(samples, last.x[15:18], last.x[18:21], self.spec))
        if last.keyframe:
            carried = preintegrate(samples, last.x[15:18], last.x[18:21], self.spec)
        else:
            assert last.imu is not None
            carried = last.imu.extended(samples)
            self.frames.pop()
        frame = self._frame(state, keyframe, observations, tags)
        frame.carry(carried)
        frame.still_sigma = self.config.still_sigma_m_s if standstill else 0.0
        if not self.frames[-1].omega.any():
            self.frames[-1].omega = samples.gyro[0] - last.x[15:18]

    def _frame(
        self, state: NavState, keyframe: bool, observations: Observations, tags: Sequence[TagView]
    ) -> WindowFrame:
        seen = Seen.of(observations, self.cameras)
        frame = WindowFrame(self._next_key, state.t_ns, row_of(state), keyframe, seen, [SeenTag(v) for v in tags])
        self._next_key += 1
        for view in tags:
            T_world_cam = state.T_world_body @ pose_of(self.mounts[view.camera])
            self.tag_states.sighted(view, T_world_cam)
        self.frames.append(frame)
        self._problem = self._covariance = None
        return frame

    def declare(self, tag: Tag) -> None:
        """What is known of a tag beforehand; needed before its first sighting is added."""
        self.tag_states.declare(tag)

    def knows(self, tag: str) -> bool:
        """Whether a tag was declared."""
        return tag in self.tag_states.number

    def is_known(self, tag: str) -> bool:
        """Whether a sighting of it can contradict something: it was surveyed, or has been seen."""
        return self.knows(tag) and self.tag_states.is_known(tag)

    def admit(self, tag: str) -> None:
        """Its sightings that were held, and agreed, count from the next solve on."""
        for frame in self.frames:
            for seen in frame.tags:
                seen.use |= seen.view.id == tag and seen.tested and seen.agrees

    def tag(self, tag: str) -> tuple[SE3, Array]:
        """Where a tag is believed, with the covariance in the chart of SE3.perturbed; it must be known."""
        state = self.tag_states.states[self.tag_states.number[tag]]
        estimated = self.tags().get(tag) if state.lin is not None else None
        if estimated is not None:
            return estimated
        return pose_of(state.row), np.zeros((6, 6)) if state.belief is None else inverse(state.belief.information)

    def forget(self, tracks: Iterable[int]) -> None:
        """These tracks are wrong: nothing of them is used any more."""
        gone = np.fromiter(tracks, np.int64)
        for frame in self.frames:
            frame.seen = frame.seen.kept(~np.isin(frame.seen.track, gone))
        self._keep_landmarks(~np.isin(self.landmark_track, gone))
        self._problem = self._covariance = None

    # -- the estimate

    def solve(self, iterations: int | None = None) -> Solution:
        """Estimate everything anew; at its end the oldest keyframe leaves if there is one too many."""
        usual = self.config.iterations if self.frames[-1].keyframe else self.config.tail_iterations
        most = usual if iterations is None else iterations
        for before, frame in zip(self.frames, self.frames[1:], strict=False):
            frame.follow(before.x)
        newest = self.frames[-1]
        doubtful = [s for s in newest.tags if not s.tested and self.tag_states.is_known(s.view.id)]
        problem, rows = build(self, without=doubtful)
        enough = SETTLED_CHI2 if newest.keyframe else CONVERGED_CHI2
        taken = problem.minimize(most, enough)
        if taken >= 0 and doubtful:
            self.tag_states.test(problem, doubtful, self.config)
            if any(s.use for s in doubtful):
                store(self, problem, rows)
                problem, rows = build(self)
                taken = problem.minimize(most, enough)
        n = len(problem.sightings)
        if taken < 0:
            return Solution(False, np.inf, 0, n, 0, np.zeros(0, np.int64))
        good = self._retested(problem) if newest.keyframe else True
        rejected = store(self, problem, rows)
        self._problem, self._covariance = problem, None
        self._carry_prior()
        seen_now = problem.sightings.frame == len(self.frames) - 1
        track = np.repeat(problem.sightings.track, np.diff(problem.sightings.start))
        solution = Solution(
            good, problem.linear.cost, taken, n, n - int(rejected.sum()),
            np.unique(track[seen_now & rejected]),
            problem.linear.imu_chi2 / max(15 * int(problem.use_imu.sum()), 1),
            {s.view.id: s.chi2 for s in newest.tags},
            tuple(s.view.id for s in newest.tags if not s.agrees),
        )  # fmt: skip
        if newest.keyframe and sum(f.keyframe for f in self.frames) > self.config.keyframes:
            self.covariance()
            self._departed.append(marginalize_oldest(self))
            forget_tags(self)
            self._problem = None
        return solution

    def _retested(self, problem: Problem) -> bool:
        """Leave out what is no measurement of its point, and settle without it: what leaves the window is final."""
        bound = self.config.reject_px**2
        good = problem.linear.chi2 <= bound
        if not good.all():
            problem.active = good
            return problem.minimize(1) >= 0
        return True

    def predict(self, t_ns: int, imu: ImuSamples) -> NavState:
        """The newest state carried on by the IMU."""
        last = self.frames[-1]
        samples = imu.between(last.t_ns, t_ns)
        return last.state.predicted(preintegrate(samples, last.x[15:18], last.x[18:21], self.spec))

    @property
    def newest(self) -> NavState:
        return self.frames[-1].state

    def covariance(self) -> Array:
        """(15, 15) of the newest state: theta, p, v, gyro bias, accelerometer bias; its first 6 are an Estimate's."""
        if self._covariance is None:
            problem = self._problem
            if problem is None:
                problem, _ = build(self)
                problem.linearize(problem.state, problem.linear)
            found = problem.covariance(problem.columns(("frame", self.frames[-1].key)))
            self._covariance = np.diag(np.repeat([10.0, 1e6, 1e4, 1.0, 10.0], 3)) if found is None else found
        return self._covariance

    def keyframes(self) -> list[NavState]:
        """Oldest first."""
        return [f.state for f in self.frames if f.keyframe]

    def landmarks(self) -> Landmarks:
        """Of the last solve."""
        w = self.landmark_world
        with np.errstate(divide="ignore", invalid="ignore"):
            xyz = w[:, :3] / np.maximum(w[:, 3:], 1e-6)
        return Landmarks(
            self.landmark_track, xyz, self.landmark_inv_depth, self.landmark_sigma, self.landmark_seen
        )  # fmt: skip

    def departed(self) -> list[Departed]:
        """Keyframes that left since this was last asked."""
        out, self._departed = self._departed, []
        return out

    def tags(self) -> dict[str, tuple[SE3, Array]]:
        """Estimated tags that are in the window, with the covariance of each in the chart of SE3.perturbed."""
        problem = self._problem
        if problem is None:
            problem, _ = build(self)
            problem.linearize(problem.state, problem.linear)
        out = {}
        for number, at in zip(problem.keys_tag, problem.tag_column, strict=True):
            if at >= 0:
                covariance = problem.covariance(at + np.arange(6))
                state = self.tag_states.states[number]
                out[state.id] = (pose_of(state.row), np.eye(6) if covariance is None else covariance)
        return out

    def extrinsics(self) -> list[SE3]:
        """T_body_cam of every camera, as the rig says or as estimated."""
        return [pose_of(row) for row in self.mounts]

    @property
    def time_offset_s(self) -> float:
        """To be added to the stamps of the images, beyond what the rig says."""
        return float(self.offset_s[0])

    # -- frames

    def align(
        self, T_new_old: SE3, release_gauge: bool = True, move_tags: bool = True, adrift: Array | None = None
    ) -> None:
        """Move the whole window rigidly into another frame: a turn about z and a translation.

        release_gauge : what the prior knew of absolute yaw and position is forgotten, as it was of the old frame; or it
        may be off, given adrift (4, 4), by a turn about z and a shift of that covariance
        move_tags : estimated tags outside the window move as well (another frame), or stay (a loop's correction)
        Raises ValueError where T_new_old tilts the vertical.
        """
        R, t = T_new_old.R, T_new_old.t
        if abs(R[2, 2] - 1.0) > 1e-9:
            raise ValueError("the window may only be turned about the vertical: gravity is known")

        def moved(row: Array) -> Array:
            return moved_row(row, R, t)

        for frame in self.frames:
            frame.x = moved(frame.x)
            frame.lin = None if frame.lin is None else moved(frame.lin)
        self.landmark_world[:, :3] = self.landmark_world[:, :3] @ R.T + self.landmark_world[:, 3:] * t
        for key, belief in self.beliefs.items():
            if key[0] == "frame":
                B = np.eye(15)
                B[3:6, 3:6] = B[6:9, 6:9] = R
                self.beliefs[key] = Belief(moved(belief.mean), B @ belief.information @ B.T)
        self.tag_states.move(moved, R, move_tags)
        self.prior = self.prior.turned(R)
        if release_gauge:
            self._release_gauge(adrift)
        self._problem = self._covariance = None

    def _carry_prior(self) -> None:
        """Turn what the prior is linearized about along with the window.

        Where yaw is hardly known it moves by degrees, and a prior about the old one would take the second order of that
        turn for a measurement of yaw.
        """
        held = [(f, f.lin) for f in self.frames if f.lin is not None]
        if not held:
            return
        now, lin = held[-1][0].x, held[-1][1]
        T = level(pose_of(now) @ pose_of(lin).inverse(), lin[9:12])
        yaw = float(np.arctan2(T.R[1, 0], T.R[0, 0]))
        if abs(yaw) < CARRY_RAD:
            return
        for frame, row in held:
            frame.lin = moved_row(row, T.R, T.t)
        for state in self.tag_states.states:
            state.lin = None if state.lin is None else moved_row(state.lin, T.R, T.t)
        step = now[9:12] - lin[9:12] - yaw * np.array([-now[10], now[9], 0.0])
        self.prior = self.prior.carried(T.R, self.lin_rows(), np.array([yaw, *step]))
        self._problem = None

    def lin_rows(self) -> dict[Key, Array]:
        """Where the prior's unknowns are linearized."""
        rows: dict[Key, Array] = {("pose", f.key): f.lin for f in self.frames if f.lin is not None}
        rows |= {("tag", n): s.lin for n, s in enumerate(self.tag_states.states) if s.lin is not None}
        return rows

    def _release_gauge(self, adrift: Array | None) -> None:
        for key in [key for key in self.beliefs if key[0] == "frame"]:  # nothing has left yet, and no prior is there
            belief = self.beliefs.pop(key)
            next(frame for frame in self.frames if frame.key == key[1]).lin = belief.mean.copy()
            self.prior = Prior([("pose", key[1]), ("rest", key[1])], belief.information, np.zeros(15))
        self.prior = self.prior.released(self.lin_rows(), adrift)

    def _keep_landmarks(self, mask: AnyArray) -> None:
        for name in ("track", "world", "sigma", "seen", "inv_depth"):
            setattr(self, f"landmark_{name}", getattr(self, f"landmark_{name}")[mask])
