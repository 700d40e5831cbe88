"""Visual-inertial odometry: messages in, a smooth path out. Read `_step` first.

The `map` frame: z up, its origin where the start was; it never jumps while the window lives. When the window fails,
a new one begins, and goes on where the old one was left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lodelight.estimation.window import Observations, Solution, StartSigma, Window, WindowConfig
from lodelight.features.klt import KltConfig, KltTracker, Tracks
from lodelight.geometry.se3 import SE3
from lodelight.imu.initialization import StartConfig, Started, Starter, StartView
from lodelight.imu.preintegration import NavState
from lodelight.imu.samples import ImuSamples
from lodelight.imu.stream import ImuStream
from lodelight.imu.vibration import Vibration
from lodelight.messages import Frame, Imu, Status, TagSighting
from lodelight.odometry.gap import Continuation, Left, continued
from lodelight.odometry.keyframing import KeyframeRule, LastKeyframe, keyframe_reason
from lodelight.odometry.probation import Probation
from lodelight.odometry.surveyed import SurveyedTags
from lodelight.odometry.tag_start import ScaleCheck, TagStart
from lodelight.odometry.tag_views import NewTags, tag_views
from lodelight.rig import Rig
from lodelight.tags.gate import KnownTag
from lodelight.types import Array

EventSink = Callable[..., None]
CONTRADICTION = "images and IMU contradict each other"
TURNED_DEG = 10.0  # within a window, that shows that the gyroscope's unit and axes are right
UNKNOWN_15 = np.diag(np.repeat([math.pi**2, 1e6, 1e4, 1.0, 10.0], 3))


@dataclass(frozen=True)
class OdometryConfig:
    """few_tracks : in agreement with the window, below which a frame is degraded
    blind_s : without them for so long, and the IMU alone is believed no more
    most_speed m/s, most_bias_gyro rad/s, most_bias_accel m/s^2 : a window that believes more has failed
    most_imu_chi2 : per degree of freedom, of the IMU in a window that is believed; likewise
    start_iterations : of the first solution
    still_px, still_gyro, still_accel : a frame whose tracks moved and whose IMU deviates by less has no velocity; px,
        rad/s, m/s^2
    vibration : share of the fast changes of the IMU that counts as white noise (imu/vibration.py)
    """

    few_tracks: int = 15
    blind_s: float = 1.0
    most_speed: float = 30.0
    most_bias_gyro: float = 0.5
    most_bias_accel: float = 2.0
    most_imu_chi2: float = 4.0
    start_iterations: int = 10
    still_px: float = 0.35
    still_gyro: float = 0.02
    still_accel: float = 0.25
    vibration: float = 0.3
    klt: KltConfig = field(default_factory=KltConfig)
    start: StartConfig = field(default_factory=StartConfig)
    keyframes: KeyframeRule = field(default_factory=KeyframeRule)
    window: WindowConfig = field(default_factory=WindowConfig)


@dataclass(frozen=True, eq=False)
class OdometryStep:
    """One frame. state : T_map_body, velocity and biases; covariance (15, 15) of it
    keyframe : the reason why it is one, empty where it is none; why : of a status that is not plain tracking
    restarted : this frame is the first of a new window; tags : that were seen in it
    tied : surveyed tags had a say in it: it lies where they put it
    """

    frame: Frame
    status: Status
    state: NavState
    covariance: Array
    tracks: Tracks
    inliers: int = 0
    keyframe: str = ""
    why: str = ""
    restarted: bool = False
    tags: tuple[TagSighting, ...] = ()
    tied: bool = False


class InertialOdometry:
    """sensors : "mono", "stereo" or "rgbd", with an IMU. on_event : told of starts, failures and faults of the IMU."""

    def __init__(
        self, rig: Rig, sensors: str, config: OdometryConfig | None = None, on_event: EventSink | None = None,
        seed: int = 0,
    ) -> None:  # fmt: skip
        self.config = config or OdometryConfig()
        assert rig.imu is not None
        self.rig = rig.with_cameras(2 if sensors == "stereo" else 1)
        self.emit: EventSink = on_event or (lambda t_ns, kind, **fields: None)
        self.tracker = KltTracker(rig, sensors, self.config.klt, seed)
        self.stream = ImuStream(rig.imu, self.emit)
        self.vibration = Vibration(rig.imu, self.config.vibration)
        self.spec = self.vibration.spec
        self.camera = rig.cameras[0].camera
        self.R_body_cam = rig.cameras[0].T_body_cam.R
        self.starter = Starter(
            self.spec, [c.T_body_cam for c in self.rig.cameras], self.camera.focal_px, sensors != "mono",
            self.config.start,
        )  # fmt: skip
        self.window: Window | None = None
        self.restarts = 0
        self._pending: tuple[Frame, Sequence[TagSighting]] | None = None
        self._contradicted: dict[str, int] = {}  # frames in a row in which a tag did
        self._surveyed = SurveyedTags()
        self._new_tags = NewTags(rig.cameras[0])
        self._probation = Probation(rig.cameras[0])
        self._last_ns: int | None = None
        self._keyframe: LastKeyframe | None = None
        self._blind_since: int | None = None
        self._left: Left | None = None  # where the last window was left
        self._believed = self._nowhere(0), UNKNOWN_15  # the last state that was, and its covariance
        self._views: list[tuple[Tracks, Sequence[TagSighting]]] = []  # of the starter's images
        self._tag_start = TagStart(rig.cameras[0])
        self._check: ScaleCheck | None = None

    # -- messages -----------------------------------------------------------------------------------------------

    def feed_imu(self, sample: Imu) -> OdometryStep | None:
        """A sample; where a frame waited for it, that frame's step."""
        self.stream.add(sample)
        if self._pending is not None and self.stream.reaches(self._pending[0].t_ns):
            return self.flush()
        return None

    def feed_frame(self, frame: Frame, tags: Sequence[TagSighting] = ()) -> OdometryStep | None:
        """A frame. It waits for the sample behind it, so that its time is covered; a step is that of an earlier frame
        or of this one."""
        waited = self.flush()
        self._pending = (frame, tags)
        if waited is None and self.stream.reaches(frame.t_ns):
            return self.flush()
        return waited

    def flush(self) -> OdometryStep | None:
        """The frame that waits, if any, with the samples there are."""
        if self._pending is None:
            return None
        (frame, tags), self._pending = self._pending, None
        return replace(self._step(frame, tags), tags=tuple(tags))

    def tie(self, known: Mapping[str, KnownTag], again: bool = False) -> bool:
        """Surveyed tags by name, where they hang in the map's frame; whether the window was laid down among them.

        again : they agree that it lies elsewhere than it believes, and may move it as far as they like
        """
        self._surveyed.learn(known, self.window)
        self._surveyed.tied &= not again
        return self._lay_down() is not None

    # -- one frame ----------------------------------------------------------------------------------------------

    def _step(self, frame: Frame, tags: Sequence[TagSighting]) -> OdometryStep:
        imu, missing = self._imu_since_last(frame.t_ns)
        self._last_ns = frame.t_ns
        if self.window is None:
            return self._try_start(frame, imu, missing, tags)
        if imu is None:
            return self._fail(frame, missing)
        window = self.window
        predicted = window.predict(frame.t_ns, imu)
        moved = self._lay_down(tags, predicted.T_world_body)
        predicted = predicted if moved is None else _moved(predicted, moved)
        R_now_last = self.R_body_cam.T @ predicted.T_world_body.R.T @ window.newest.T_world_body.R @ self.R_body_cam
        tracks = self.tracker.process(frame, R_now_last, sigma_rotation=2e-3)
        T_map_cam = predicted.T_world_body @ self.rig.cameras[0].T_body_cam
        views, new = tag_views(
            window, tags, T_map_cam, self._surveyed.declaration, self._place, self._probation
        )  # fmt: skip
        reason = self._keyframe_reason(tracks, predicted.T_world_body)
        reason = reason or (f"first sight of {new[0]}" if new else "")
        window.add_frame(
            frame.t_ns, imu, self._observations(tracks), views, bool(reason), self._still(imu), guess=predicted
        )
        solution = window.solve()
        used = {seen.view.id for seen in window.frames[-1].tags if seen.use}
        self._judge_tags(tags, solution)
        state = window.newest
        inliers = len(tracks) - len(solution.outliers)
        failure = self._failure(solution, state)
        self.starter.doubted |= bool(failure)
        failure = failure or self._wrong_scale(tracks, imu, state.T_world_body)
        blind = "" if failure else self._blind(inliers, frame.t_ns)
        if failure or blind:
            return self._fail(frame, failure or blind, reliable=not failure)
        self.tracker.drop(solution.outliers)
        if reason:
            self._keyframe = LastKeyframe(frame.t_ns, state.T_world_body, tracks)
        few = self._blind_since is not None
        why = f"{inliers} tracks agree, fewer than {self.config.few_tracks}: the IMU carries the pose" if few else ""
        self._believed = state, self._covariance(window)
        oldest = window.keyframes()[0].T_world_body
        self.starter.turns_fit |= (oldest.inverse() @ state.T_world_body).exceeds(np.inf, TURNED_DEG)
        self.stream.forget_before(frame.t_ns)
        return OdometryStep(
            frame, "degraded" if few else "tracking", *self._believed, tracks, inliers, reason, why,
            tied=self._surveyed.tied and not used.isdisjoint(self._surveyed.known),
        )  # fmt: skip

    def _lay_down(self, tags: Sequence[TagSighting] = (), T_map_body: SE3 | None = None) -> SE3 | None:
        """Move the window among the surveyed tags, if it does not lie there yet and one is known, or is in sight from
        about T_map_body."""
        window = self.window
        if window is None:
            return None
        T_map_cam = None if T_map_body is None else T_map_body @ self.rig.cameras[0].T_body_cam
        laid = self._surveyed.lay_down(
            window, tags, lambda s: None if T_map_cam is None else self._place(s, T_map_cam)
        )  # fmt: skip
        if laid is None:
            return None
        moved, name = laid
        self._probation.admit(name, window.newest.t_ns)
        if self._check is not None:
            self._check.move(moved)
        if self._keyframe is not None:
            self._keyframe = replace(self._keyframe, T_map_body=moved @ self._keyframe.T_map_body)
        return moved

    def _place(self, s: TagSighting, T_map_cam: SE3) -> SE3 | None:
        assert self.window is not None
        return self._new_tags.place(s, T_map_cam, self.window)

    def _judge_tags(self, tags: Sequence[TagSighting], solution: Solution) -> None:
        """Admit tags whose views have shown where they hang; name those that the window left out twice in a row, as
        one that hangs right may miss the test once in a hundred, and those that hang otherwise."""
        assert self.window is not None
        for name, t_ns, why in self._new_tags.wrong():
            self._name(name, t_ns, why)
        for s in tags:
            chi2 = solution.tag_chi2.get(s.name)
            if chi2 is None:
                continue
            rejected = s.name in solution.tag_rejected
            self._contradicted[s.name] = self._contradicted.get(s.name, 0) + 1 if rejected else 0
            why = self._probation.judge(s, self.window, rejected)
            if not why and self._contradicted[s.name] == 2 and not self._probation.named(s.name):
                why = f"its corners contradict the window's (chi-square {chi2:.0f}); it is not used there"
            if why:
                self._name(s.name, s.t_ns, why)

    def _name(self, tag: str, t_ns: int, why: str) -> None:
        self.emit(t_ns, "tag", tag=tag, verdict="contradicts", why=why)

    def _imu_since_last(self, t_ns: int) -> tuple[ImuSamples | None, str]:
        if self._last_ns is None:
            return None, "the first frame"
        found = self.stream.between(self._last_ns, t_ns)
        if isinstance(found, str):
            return None, found
        self.spec = self.vibration.add(found)
        if self.window is not None:
            self.window.spec = self.spec
        return found, ""

    def _observations(self, tracks: Tracks) -> Observations:
        right = np.flatnonzero(tracks.stereo)
        n, m = len(tracks), len(right)
        inv_depth, sigma = tracks.inv_depth, tracks.sigma_inv_depth
        if m:  # what two cameras say is said by their pixels
            inv_depth, sigma = np.zeros(n), np.zeros(n)
        none = np.zeros(m)
        noise = np.concatenate([tracks.step_px, tracks.right_px[right]])
        return Observations(
            np.concatenate([tracks.id, tracks.id[right]]),
            np.concatenate([np.zeros(n, np.int32), np.ones(m, np.int32)]),
            np.concatenate([tracks.px, tracks.px_right[right]]).astype(np.float64),
            noise, np.concatenate([inv_depth, none]), np.concatenate([sigma, none]),
            wander_px2=np.concatenate([tracks.wander_px2, tracks.wander_px2[right]]),
        )  # fmt: skip

    def _keyframe_reason(self, tracks: Tracks, T_map_body: SE3) -> str:
        if self._keyframe is None:
            return "the first"
        return keyframe_reason(
            self._keyframe, tracks, T_map_body, self.R_body_cam, self.camera.focal_px, self.config.keyframes
        )

    def _still(self, imu: ImuSamples) -> bool:
        """Whether nothing moves: neither the tracks since the last frame, nor the IMU."""
        c, flow = self.config, self.tracker.flow
        quiet = imu.gyro.std(axis=0).max() < c.still_gyro and imu.accel.std(axis=0).max() < c.still_accel
        return bool(quiet and flow.followed >= c.start.min_tracks and flow.moved_px < c.still_px)

    # -- start, failure -----------------------------------------------------------------------------------------

    def _try_start(
        self, frame: Frame, imu: ImuSamples | None, missing: str, tags: Sequence[TagSighting]
    ) -> OdometryStep:
        tracks = self.tracker.process(frame)
        self.starter.add(self._tag_start.with_tags(self._view(tracks), tags), imu)
        self._views = [*self._views, (tracks, tags)][-len(self.starter.views) :]
        start = self.starter.find() if imu is not None else missing
        found = self._started(start) if isinstance(start, Started) else start
        if isinstance(found, str):
            status: Status = "lost" if self._left is not None else "initializing"
            return OdometryStep(frame, status, self._nowhere(frame.t_ns), UNKNOWN_15, tracks, why=found)
        state = found.newest
        self._believed = state, self._covariance(found)
        self._keyframe = LastKeyframe(frame.t_ns, state.T_world_body, tracks)
        return OdometryStep(frame, "tracking", *self._believed, tracks, len(tracks), "the start", restarted=True)

    def _started(self, start: Started) -> Window | str:
        """The window, begun with the images of the start, and solved; or why that failed."""
        stamps = {state.t_ns for state in start.states}
        views, seen = zip(*[(tracks, tags) for tracks, tags in self._views if tracks.t_ns in stamps], strict=True)
        still = start.how == "at rest"
        if still:
            chosen = np.array([0, len(views) - 1])
        else:
            chosen = np.unique(np.linspace(0, len(views) - 1, min(self.config.window.keyframes, len(views))).round())
        chosen = chosen.astype(int)
        on = self._continued(start.states[int(chosen[0])])
        start_states = [_moved(state, on.T_map_new if on else SE3.identity()) for state in start.states]
        states = [start_states[i] for i in chosen]
        placed = self._placed(start, start_states, seen)
        if isinstance(placed, str):
            return placed
        sigma = StartSigma(
            tilt_rad=max(3.0 * start.sigma_tilt, 0.02), velocity_m_s=max(3.0 * start.sigma_velocity, 0.02),
            bias_gyro=max(3.0 * start.sigma_bias_gyro, 1e-3), bias_accel=self.config.start.bias_accel,
        )  # fmt: skip
        window = Window(self.rig, self.config.window, self.spec)
        tags = [self._tag_start.views(window, state, seen[i], placed) for i, state in zip(chosen, states, strict=True)]
        window.start(states[0], sigma, self._observations(views[int(chosen[0])]), tags[0])
        for i, state, those in zip(chosen[1:], states[1:], tags[1:], strict=True):
            samples = self.stream.between(window.newest.t_ns, state.t_ns)
            if isinstance(samples, str):
                return samples
            window.add_frame(
                state.t_ns, samples, self._observations(views[i]), those, keyframe=True, standstill=still, guess=state
            )
        solution = window.solve(self.config.start_iterations)
        failure = self._failure(solution, window.newest)
        if failure:
            return f"a start was found ({start.why}), but {failure}"
        self.emit(window.newest.t_ns, "start", how=start.how, why=start.why)
        self.window, self._blind_since = window, None
        self._surveyed.begin_anew(on)
        self._new_tags.seen.clear()
        self._probation.tried.clear()
        for name in placed:
            self._probation.admit(name, window.newest.t_ns)
        self._check = self._scale_check(placed) if placed or still else None
        self.starter.reset()
        self._views = []
        return window

    def _placed(
        self, start: Started, states: Sequence[NavState], seen: Sequence[Sequence[TagSighting]]
    ) -> dict[str, SE3] | str:
        """Where the tags in a start's images are; none where they tell nothing that is not known without them."""
        if not start.tags and (self.starter.metric or start.how != "at rest"):
            return {}
        placed, wrong = self._tag_start.placed(states, seen)
        for name, why in wrong.items():
            self._name(name, states[-1].t_ns, why)
        return placed if placed or not start.tags else f"it is not clear how {start.tags[0]} hangs"

    def _scale_check(self, placed: Mapping[str, SE3]) -> ScaleCheck | None:
        if self.starter.metric:
            return None
        assert self.window is not None
        sizes = {s.name: s.size_m for _, tags in self._views for s in tags if s.name in placed and s.size_m}
        return ScaleCheck(self.starter.anew(), sizes, self.window.newest.t_ns)

    def _wrong_scale(self, tracks: Tracks, imu: ImuSamples, T_map_body: SE3) -> str:
        """How large the tags are by which a window of one camera began, if not as they say."""
        check = self._check
        still = self._still(imu)
        found = None if check is None else check.add(self._view(tracks), imu, T_map_body, still)
        if check is None or (found is None and not check.over(tracks.t_ns)):
            return ""
        self._check = None
        wrong = {name: why for name, one in (found or {}).items() if (why := one.contradicts(0.0))}
        self._tag_start.refused |= set(wrong)
        for name, why in wrong.items():
            self._name(name, tracks.t_ns, why)
        return "; ".join(f"it began by {name}, but {why}" for name, why in wrong.items())

    def _continued(self, first: NavState) -> Continuation | None:
        """Where a window that begins with this state goes on; None for the first of all."""
        if self._left is None:
            return None
        samples = self.stream.between(self._left.state.t_ns, first.t_ns)
        return continued(self._left, first, samples, self.spec)

    def _covariance(self, window: Window) -> Array:
        """(15, 15) of the window's newest state; of one that goes on where another was left, of where that is too."""
        covariance = window.covariance()
        if self._surveyed.goes_on is not None:
            covariance = covariance.copy()
            covariance[:6, :6] += self._surveyed.goes_on.spread(window.newest.T_world_body)
        return covariance

    def _failure(self, solution: Solution, state: NavState) -> str:
        """Why the window is believed no more; empty where it is."""
        c = self.config
        if not solution.ok:
            return "the window's equations have no solution"
        speed = float(np.linalg.norm(state.v_world))
        if not speed < c.most_speed:
            return f"the window believes in {speed:.1f} m/s"
        gyro, accel = float(np.linalg.norm(state.bias_gyro)), float(np.linalg.norm(state.bias_accel))
        if not (gyro < c.most_bias_gyro and accel < c.most_bias_accel):
            return f"the window believes in biases of {gyro:.2f} rad/s and {accel:.2f} m/s^2"
        if not solution.imu_chi2 < c.most_imu_chi2:
            return f"{CONTRADICTION} (chi-square {solution.imu_chi2:.1f} per degree of freedom)"
        return ""

    def _blind(self, inliers: int, t_ns: int) -> str:
        """Keeps count of frames with hardly any track; why the IMU alone is believed no more, empty where it is."""
        if inliers >= self.config.few_tracks:
            self._blind_since = None
            return ""
        if self._blind_since is None:
            self._blind_since = t_ns
        blind_s = (t_ns - self._blind_since) * 1e-9
        return f"{inliers} tracks for {blind_s:.2f} s" if blind_s > self.config.blind_s else ""

    def _fail(self, frame: Frame, why: str, reliable: bool = False) -> OdometryStep:
        """Leave the window; begin to look for a new start with this very frame. reliable : it saw nothing, and is left
        for that alone."""
        assert self.window is not None
        self.emit(frame.t_ns, "failure", why=why)
        self._left = Left(*self._believed, reliable)
        self._tag_start.refused |= set() if self._check is None else set(self._check.sizes)  # it may be their fault
        self.window, self._keyframe, self._blind_since, self._check = None, None, None, None
        self.restarts += 1
        self.starter.reset()
        self._views = []
        self.tracker.reset()
        tracks = self.tracker.process(frame)
        self.starter.add(self._view(tracks), None)
        self._views = [(tracks, ())]
        return OdometryStep(frame, "lost", self._nowhere(frame.t_ns), UNKNOWN_15, tracks, why=why)

    def _nowhere(self, t_ns: int) -> NavState:
        T = self._left.state.T_world_body if self._left is not None else SE3.identity()
        return NavState(t_ns, T, np.zeros(3), np.zeros(3), np.zeros(3))

    def _view(self, tracks: Tracks) -> StartView:
        right = np.flatnonzero(tracks.stereo)
        n, none = len(tracks), np.zeros(len(right))
        ray_right = (
            self.rig.cameras[1].camera.unproject(tracks.px_right[right].astype(np.float64))[0]
            if len(right)
            else np.zeros((0, 3))
        )
        own = np.zeros(n) if len(right) else tracks.inv_depth
        return StartView(
            tracks.t_ns, np.concatenate([tracks.id, tracks.id[right]]),
            np.concatenate([np.zeros(n, np.int32), np.ones(len(right), np.int32)]),
            np.concatenate([tracks.ray, ray_right]), np.concatenate([own, none]),
            np.concatenate([tracks.sigma_inv_depth, none]), self.tracker.flow.R_now_last,
        )  # fmt: skip


def _moved(state: NavState, T: SE3) -> NavState:
    return NavState(state.t_ns, T @ state.T_world_body, T.R @ state.v_world, state.bias_gyro, state.bias_accel)
