"""One camera in a finished map: followed, carried by temporary points where the map does not hold it, found again.

`locate` is the way every frame goes; docs/localization.md has the states and the thresholds. Source: science note B.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeGuard

import numpy as np

from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.localization.beside import InlineSearch, ThreadedSearch
from lodelight.localization.follower import Follower, n_temporary
from lodelight.localization.machine import Found
from lodelight.localization.reckoning import DeadReckoning, Reckoned
from lodelight.localization.relocalize import Hint, Relocalizer, RelocalizerConfig
from lodelight.localization.states import State, States, StatesConfig, Step
from lodelight.localization.temporary import TemporaryConfig, TemporaryPoints
from lodelight.localization.tracker import Tracked, TrackerConfig
from lodelight.localization.window import adjust_window
from lodelight.mapping.map import Map
from lodelight.mapping.places import Places
from lodelight.messages import Status
from lodelight.rig import Rig
from lodelight.types import Ints

HINT_S = 2.0  # after which nothing is left of what was known of a place
TIPPED_DEG = 30.0  # off the vertical: an accelerometer that shakes is off by less

EventSink = Callable[..., None]  # called as sink(t_ns, kind, **fields)


@dataclass(frozen=True)
class SecondLookConfig:
    """What it takes to believe that the camera was found.

    inliers : points of the whole surroundings that agree with the answer: so many, and it is believed at once
    patience_s : within which a weaker answer must be found again, at a pose that motion up to speed_m_s and speed_deg_s
        explains
    every : frames of being carried from one search of the surroundings to the next
    near_m, near_deg, drift : how far the carried pose may be off, at once and as a share of the way without the map
    reach_m : from how far a place may be seen
    gain : a search beside is worth leaving for where it finds so many times the points that tracking has
    reckoned_m : standard deviation of a pose by the IMU alone up to which it is one
    """

    inliers: int = 50
    patience_s: float = 0.5
    speed_m_s: float = 2.0
    speed_deg_s: float = 200.0
    every: int = 5
    near_m: float = 0.5
    near_deg: float = 10.0
    reach_m: float = 3.0
    drift: float = 0.05
    gain: float = 1.5
    reckoned_m: float = 0.1


@dataclass(frozen=True)
class LadderConfig:
    """Every default of localization, by stage."""

    tracking: TrackerConfig = field(default_factory=TrackerConfig)
    states: StatesConfig = field(default_factory=StatesConfig)
    temporary: TemporaryConfig = field(default_factory=TemporaryConfig)
    relocalization: RelocalizerConfig = field(default_factory=RelocalizerConfig)
    second_look: SecondLookConfig = field(default_factory=SecondLookConfig)


@dataclass(frozen=True, eq=False)
class Question:
    """A carried frame, to be found in the map around it."""

    t_ns: int
    seen: Features
    T_world_body: SE3
    in_map: int
    hint: Hint


class Ladder:
    """Where the camera is in a map that it never writes.

    carrying : whether temporary points may be used; live : the search beside on its own thread
    emit : told of what happens, as emit(t_ns, kind, **fields)
    reckoning : by the rig's IMU, None without one; its samples are added to it before the frames
    places : what recognises them, if another ladder in this map has it already
    status, why : of the last frame, in the words of `Estimate`
    confirmed : (t_ns, T_world_body) of frames that were believed only after later ones had agreed
    """

    def __init__(
        self, rig: Rig, map: Map, orb: OrbConfig, config: LadderConfig, seed: int, carrying: bool, live: bool,
        emit: EventSink, reckoning: DeadReckoning | None = None, places: Places | None = None,
    ) -> None:  # fmt: skip
        self.map = map
        self.reckoning = reckoning
        self.config = config
        self.emit = emit
        self.temporary = TemporaryPoints(rig.cameras[0], orb, config.temporary, config.tracking.sigma_px)
        self.follower = Follower(rig, map, orb, config.tracking, self.temporary, seed)
        self.relocalizer = Relocalizer(map, orb, places, config.relocalization, rig.cameras[0])
        self.states = States(config.states, carrying)
        self.status: Status = "initializing"
        self.why = "not found in the map yet"
        self.confirmed: list[tuple[int, SE3]] = []
        self.hint: tuple[int, Hint] | None = None  # what others say of the camera's place, and when they did
        self._beside = (ThreadedSearch if live else InlineSearch)(self._answer)
        self._agreed: SE3 | None = None  # the correction that the last search beside asked for
        self._since_asked = 0
        self._pending: list[Tracked] = []  # an answer that waits for another that agrees
        self._known: tuple[int, Hint] | None = None  # where the camera was lost, and when

    def start(self, tracked: Tracked) -> None:
        """Begin where a frame was found."""
        self.follower.accept(tracked)
        self.temporary.forget_past()
        self.temporary.remember(tracked, tracked.right_in_map >= self.config.states.good_inliers)
        self.states.found(tracked.t_ns, tracked.right_in_map)

    # -- the way of a frame -------------------------------------------------------------------------------------

    def locate(self, t_ns: int, seen: Features) -> Tracked:
        """Pose of a frame in the map; `status` and `why` say how it was had, or why not."""
        reckoned = self.follower.reckoned = self.reckoning.predict(t_ns) if self.reckoning is not None else None
        tracked = self._follow(t_ns, seen) if self.states.state is not State.searching else None
        if tracked is None:
            tracked = self._search(t_ns, seen)
        if tracked.why_lost and self._is_known(reckoned):
            return self._reckoned(reckoned, tracked)
        if self.reckoning is not None and not tracked.why_lost:
            self.reckoning.correct(t_ns, tracked.T_world_body, tracked.covariance)
        return tracked

    def close(self) -> None:
        """Wait for the search beside, and forget what is temporary."""
        self._beside.close()
        self.temporary.clear()
        self.temporary.forget_past()
        self.follower.forget()

    @property
    def temporary_left(self) -> int:
        """Temporary points, and matches that name one, anywhere."""
        last = self.follower.last
        return len(self.temporary) + self.temporary.references + (n_temporary(last) if last else 0)

    # -- following and carrying ---------------------------------------------------------------------------------

    def _follow(self, t_ns: int, seen: Features) -> Tracked | None:
        """The frame by what was known of the last one; None where it has to be searched for."""
        last = self.follower.last
        assert last is not None
        tracked = self.follower.track(t_ns, seen)
        in_map, in_all = (0, 0) if tracked.why_lost else (tracked.right_in_map, tracked.right_in_all)
        moved_m = float(np.linalg.norm(tracked.T_world_body.t - last.T_world_body.t))
        known = self._is_known(self.follower.reckoned)
        step = self.states.judge(t_ns, in_map, in_all, moved_m, tracked.guessed, known)
        if step is Step.lost:
            self._give_up(t_ns)
            return None
        if step is Step.unsure:
            return None
        if step is Step.leave:
            tracked = self._leave(tracked, tracked.T_world_body, "the map is enough again")
        if step is Step.enter:
            self.emit(t_ns, "carried", begins=True, why=self.states.why)
        well = tracked.right_in_map >= self.config.states.good_inliers
        if self.states.state is State.carried:
            self.temporary.grow(tracked, self.follower.distances(tracked))
            if not tracked.guessed and self.temporary.remember(tracked, well):
                adjust_window(self.temporary, self.map, tracked, self.config.tracking.sigma_px)
            tracked = self._look_beside(tracked)
        else:
            self.temporary.remember(tracked, well)
        self.follower.accept(tracked)
        return self._told(tracked)

    def _told(self, tracked: Tracked) -> Tracked:
        poor = self.states.poor >= self.config.states.patience
        self.status = "degraded" if poor or self.states.state is State.carried else "tracking"
        self.why = self.states.why
        return tracked

    def _leave(self, tracked: Tracked, T_world_body: SE3, why: str) -> Tracked:
        """Without temporary points from here on: the pose of a frame by the map alone."""
        alone = self._by_map_alone(tracked, T_world_body, tracked.point)
        jump_m = float(np.linalg.norm(alone.T_world_body.t - tracked.T_world_body.t))
        self._end_carrying(tracked.t_ns, why, jump_m=jump_m)
        return alone

    def _by_map_alone(self, tracked: Tracked, T_world_body: SE3, point: Ints) -> Tracked:
        """The pose of a frame from `T_world_body` on, with the map's points alone; point : (N,) matches so far."""
        seen = tracked.seen
        index = FeatureIndex(seen, self.follower.camera.width, self.follower.camera.height)
        return self.follower.refine(tracked.t_ns, seen, T_world_body, point, index, search=5.0, map_alone=True)

    def _end_carrying(self, t_ns: int, why: str, **fields: float) -> None:
        cleared, carried_m = len(self.temporary), self.states.carried_m
        self.follower.forget_temporary()
        self._agreed = None
        self.emit(t_ns, "carried", begins=False, why=why, cleared=cleared, carried_m=carried_m, **fields)

    def _give_up(self, t_ns: int) -> None:
        """No pose any more: what is temporary is cleared; where the camera was last is a hint for a while."""
        last = self.follower.last
        assert last is not None
        reach_m = self.config.second_look.reach_m + self.config.second_look.drift * self.states.carried_m
        self._known = (last.t_ns, Hint(last.T_world_body, reach_m))
        if len(self.temporary):
            self._end_carrying(t_ns, self.states.why)
        self.follower.forget()
        self.temporary.forget_past()

    # -- by the IMU alone ---------------------------------------------------------------------------------------

    def _is_known(self, reckoned: Reckoned | None) -> TypeGuard[Reckoned]:
        """Whether the IMU alone says well enough where a camera is that was followed until now."""
        following = self.states.state is not State.searching
        return reckoned is not None and following and reckoned.sigma_m <= self.config.second_look.reckoned_m

    def _reckoned(self, reckoned: Reckoned, tracked: Tracked) -> Tracked:
        """A frame that shows too little, where the IMU says."""
        self.status, self.why = "degraded", f"by the IMU alone: {tracked.why_lost}"
        return replace(
            tracked, T_world_body=reckoned.T_map_body, covariance=reckoned.covariance, why_lost="",
            reference=self.follower.last.reference if self.follower.last is not None else 0,
        )  # fmt: skip

    # -- the search beside --------------------------------------------------------------------------------------

    def _look_beside(self, tracked: Tracked) -> Tracked:
        """Ask for the carried frame in the map around it; leave where two answers in a row agree."""
        self._since_asked += 1
        if self._since_asked >= self.config.second_look.every and self._beside.idle:
            self._since_asked = 0
            self._beside.ask(self._question(tracked))
        answer = self._beside.answer()
        if answer is None:
            return tracked
        question, found = answer
        correction = self._correction(question, found)
        if correction is None:
            self._agreed = None
            return tracked
        if self._agreed is None or not self._alike(self._agreed, correction, tracked):
            self._agreed = correction
            return tracked
        corrected = correction @ tracked.T_world_body
        nothing = np.full(len(tracked.seen), -1, np.int32)
        alone = self._by_map_alone(tracked, corrected, nothing)
        if alone.why_lost or alone.right_in_map < max(self.config.states.min_inliers, tracked.right_in_map):
            return tracked
        jump_m = float(np.linalg.norm(alone.T_world_body.t - tracked.T_world_body.t))
        why = f"{found.why} beside, twice alike" if isinstance(found, Found) else ""
        self.states.leave("")
        self._end_carrying(tracked.t_ns, why, jump_m=jump_m)
        self.follower.forget()
        return alone

    def _question(self, tracked: Tracked) -> Question:
        look = self.config.second_look
        hint = Hint(tracked.T_world_body, look.reach_m + 0.03 * self.states.carried_m)
        return Question(tracked.t_ns, tracked.seen, tracked.T_world_body, tracked.right_in_map, hint)

    def _answer(self, question: Question) -> tuple[Question, Found | str]:
        return question, self.relocalizer.find(question.seen, question.hint)

    def _correction(self, question: Question, found: Found | str) -> SE3 | None:
        """T_world_carried: from where the camera was carried to where it is, if an answer is to be believed."""
        look = self.config.second_look
        if isinstance(found, str):
            return None
        n = int(np.count_nonzero(found.point >= 0))
        if n < max(look.inliers, look.gain * question.in_map):
            return None
        off = question.T_world_body.inverse() @ found.T_world_body
        if np.linalg.norm(off.t) > max(look.near_m, look.drift * self.states.carried_m):
            return None
        return found.T_world_body @ question.T_world_body.inverse() if np.degrees(off.angle) <= look.near_deg else None

    def _alike(self, a: SE3, b: SE3, tracked: Tracked) -> bool:
        """Whether two corrections put the present frame at one place."""
        look = self.config.second_look
        off = (a @ tracked.T_world_body).inverse() @ (b @ tracked.T_world_body)
        return bool(np.linalg.norm(off.t) <= 0.5 * look.near_m and np.degrees(off.angle) <= 0.5 * look.near_deg)

    # -- global relocalization ----------------------------------------------------------------------------------

    def _search(self, t_ns: int, seen: Features) -> Tracked:
        """Find a frame in the map with little or nothing known of where it is, and look again before it is believed."""
        found = self._find(t_ns, seen)
        if isinstance(found, str):
            return self._nowhere(t_ns, seen, found)
        look = self.config.second_look
        asked = Tracked(t_ns, seen, found.T_world_body, found.covariance, found.point, 0)
        tracked = self._by_map_alone(asked, found.T_world_body, found.point)
        if tracked.why_lost or tracked.right_in_map < self.config.states.min_inliers:
            return self._nowhere(t_ns, seen, f"{found.why}, but {tracked.right_in_map} on a second look")
        tipped_deg = self.reckoning.tipped_deg(t_ns, tracked.T_world_body) if self.reckoning is not None else 0.0
        if tipped_deg > TIPPED_DEG:
            return self._nowhere(t_ns, seen, f"{found.why}, but {tipped_deg:.0f} degrees off the vertical")
        waiting: list[Tracked] = []
        if tracked.right_in_map < look.inliers:
            if not self._pending or not self._explained(self._pending[-1], tracked):
                self._pending = [tracked]
                return self._nowhere(t_ns, seen, f"{found.why}, too few to be believed before it is found again")
            waiting = self._pending
        return self._found(tracked, found.why, waiting)

    def _find(self, t_ns: int, seen: Features) -> Found | str:
        """By what was told of the place, if anything; else around the last pose while it is fresh, then anywhere."""
        for known, alone in ((self.hint, True), (self._last_known(), False)):
            if known is None or (t_ns - known[0]) * 1e-9 > HINT_S:
                continue
            age_s = abs(t_ns - known[0]) * 1e-9
            hint = replace(known[1], radius_m=known[1].radius_m + self.config.second_look.speed_m_s * age_s)
            found = self.relocalizer.find(seen, hint)
            if alone or isinstance(found, Found):
                return found
        return self.relocalizer.find(seen)

    def _last_known(self) -> tuple[int, Hint] | None:
        """Where the camera was last, or is by its IMU."""
        last, reckoned, reach_m = self.follower.last, self.follower.reckoned, self.config.second_look.reach_m
        if reckoned is not None and reckoned.sigma_m < reach_m:
            return reckoned.t_ns, Hint(reckoned.T_map_body, reach_m, reckoned.covariance)
        if last is None:
            return self._known
        return last.t_ns, Hint(last.T_world_body, reach_m)

    def _explained(self, before: Tracked, now: Tracked) -> bool:
        """Whether a camera can have moved from one answer to the next, in the time it had."""
        look = self.config.second_look
        dt_s = (now.t_ns - before.t_ns) * 1e-9
        apart = before.T_world_body.inverse() @ now.T_world_body
        soon = dt_s <= look.patience_s
        near = float(np.linalg.norm(apart.t)) <= 0.1 + look.speed_m_s * dt_s
        return bool(soon and near and np.degrees(apart.angle) <= 5.0 + look.speed_deg_s * dt_s)

    def _found(self, tracked: Tracked, why: str, waiting: list[Tracked]) -> Tracked:
        if self.states.state is State.carried:
            self._end_carrying(tracked.t_ns, "found by itself")
        self.confirmed += [(before.t_ns, before.T_world_body) for before in waiting]
        self._pending, self._known = [], None
        last = self.follower.last
        if last is not None and not self._explained(last, tracked):
            self.follower.forget()  # else the motion since then is worth knowing
        self.start(tracked)
        self.status, self.why = "relocalized", f"{why}; {tracked.right_in_map} on a second look"
        self.emit(tracked.t_ns, "relocalization", why=self.why, inliers=tracked.n_inliers)
        return tracked

    def _nowhere(self, t_ns: int, seen: Features, why: str) -> Tracked:
        """A frame without a pose: where the camera was last, known no better than the building."""
        if self.status != "initializing":
            self.status = "lost"
        self.why = "; ".join(filter(None, [self.states.why, why]))
        last = self.follower.last
        where = last.T_world_body if last else self._known[1].T_world_body if self._known else SE3.identity()
        nothing = np.full(len(seen), -1, np.int32)
        return Tracked(t_ns, seen, where, np.eye(6), nothing, 0, why_lost=self.why)
