"""One camera in a finished map: followed, carried by temporary points where the map does not hold it, found again.

`locate` is the way every frame goes; docs/localization.md has the states and the thresholds. Source: science note B.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeGuard

import numpy as np

from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.localization.follower import Follower, n_temporary
from lodelight.localization.growth import Growth
from lodelight.localization.reckoning import DeadReckoning, Reckoned
from lodelight.localization.relocalize import Relocalizer, RelocalizerConfig
from lodelight.localization.second_look import SecondLook, SecondLookConfig
from lodelight.localization.states import State, States, StatesConfig, Step
from lodelight.localization.surroundings import Surroundings
from lodelight.localization.temporary import TemporaryConfig, TemporaryPoints
from lodelight.localization.tracker import Tracked, TrackerConfig
from lodelight.localization.window import adjust_window
from lodelight.mapping.map import Map
from lodelight.mapping.places import Places
from lodelight.messages import Status
from lodelight.rig import Rig

EventSink = Callable[..., None]  # called as sink(t_ns, kind, **fields)


@dataclass(frozen=True)
class LadderConfig:
    """Every default of localization, by stage."""

    tracking: TrackerConfig = field(default_factory=TrackerConfig)
    states: StatesConfig = field(default_factory=StatesConfig)
    temporary: TemporaryConfig = field(default_factory=TemporaryConfig)
    relocalization: RelocalizerConfig = field(default_factory=RelocalizerConfig)
    second_look: SecondLookConfig = field(default_factory=SecondLookConfig)


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
        self.growth = Growth(self.temporary)
        self.relocalizer = Relocalizer(map, orb, places, config.relocalization, rig.cameras[0])
        self.surroundings = Surroundings(self.relocalizer, config.second_look, live)
        self.second_look = SecondLook(
            self.follower, self.relocalizer, config.second_look, config.states.min_inliers, reckoning
        )
        self.states = States(config.states, carrying)
        self.status: Status = "initializing"
        self.why = "not found in the map yet"
        self.confirmed: list[tuple[int, SE3]] = []

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
        self.surroundings.close()
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
            alone = self.follower.by_map_alone(t_ns, tracked.seen, tracked.T_world_body, tracked.point)
            tracked = self._leave(tracked, alone, "the map is enough again")
        if step is Step.enter:
            self.emit(t_ns, "carried", begins=True, why=self.states.why)
        well = tracked.right_in_map >= self.config.states.good_inliers
        if self.states.state is State.carried:
            self.growth.grow(tracked, self.follower.distances(tracked))
            if not tracked.guessed and self.temporary.remember(tracked, well):
                adjust_window(self.temporary, self.map, tracked, self.config.tracking.sigma_px)
            tracked = self._look_around(tracked)
        else:
            self.temporary.remember(tracked, well)
        self.follower.accept(tracked)
        return self._told(tracked)

    def _told(self, tracked: Tracked) -> Tracked:
        poor = self.states.poor >= self.config.states.patience
        self.status = "degraded" if poor or self.states.state is State.carried else "tracking"
        self.why = self.states.why
        return tracked

    def _leave(self, tracked: Tracked, alone: Tracked, why: str) -> Tracked:
        """Without temporary points from here on: a frame as the map alone has it."""
        jump_m = float(np.linalg.norm(alone.T_world_body.t - tracked.T_world_body.t))
        self._end_carrying(tracked.t_ns, why, jump_m=jump_m)
        return alone

    def _end_carrying(self, t_ns: int, why: str, **fields: float) -> None:
        cleared, carried_m = len(self.temporary), self.states.carried_m
        self.follower.forget_temporary()
        self.surroundings.forget()
        self.emit(t_ns, "carried", begins=False, why=why, cleared=cleared, carried_m=carried_m, **fields)

    def _look_around(self, tracked: Tracked) -> Tracked:
        """The frame by the map around it, if that holds it better than what carries it does."""
        answer = self.surroundings.look(tracked, self.states.carried_m)
        if answer is None:
            return tracked
        T_world_body, why = answer
        alone = self.follower.by_map_alone(tracked.t_ns, tracked.seen, T_world_body)
        if alone.why_lost or alone.right_in_map < max(self.config.states.min_inliers, tracked.right_in_map):
            return tracked
        self.states.leave("")
        self._leave(tracked, alone, why)
        self.follower.forget()
        return alone

    def _give_up(self, t_ns: int) -> None:
        """No pose any more: what is temporary is cleared; where the camera was last is a hint for a while."""
        last = self.follower.last
        assert last is not None
        self.second_look.lost(last, self.states.carried_m)
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

    # -- global relocalization ----------------------------------------------------------------------------------

    def _search(self, t_ns: int, seen: Features) -> Tracked:
        """A frame of a camera that may be anywhere."""
        found = self.second_look.find(t_ns, seen)
        if isinstance(found, str):
            return self._nowhere(t_ns, seen, found)
        if self.states.state is State.carried:
            self._end_carrying(t_ns, "found by itself")
        self.confirmed += [(before.t_ns, before.T_world_body) for before in found.waited]
        last, tracked = self.follower.last, found.tracked
        if last is not None and not self.second_look.explained(last, tracked):
            self.follower.forget()  # else the motion since then is worth knowing
        self.start(tracked)
        self.status, self.why = "relocalized", found.why
        self.emit(t_ns, "relocalization", why=self.why, inliers=tracked.n_inliers)
        return tracked

    def _nowhere(self, t_ns: int, seen: Features, why: str) -> Tracked:
        """A frame without a pose: where the camera was last, known no better than the building."""
        if self.status != "initializing":
            self.status = "lost"
        self.why = "; ".join(filter(None, [self.states.why, why]))
        last, known = self.follower.last, self.second_look.known
        where = last.T_world_body if last else known[1].T_world_body if known else SE3.identity()
        nothing = np.full(len(seen), -1, np.int32)
        return Tracked(t_ns, seen, where, np.eye(6), nothing, 0, why_lost=self.why)
