"""The states of localization in a map, by counts alone: which is next, and why.

N is the number of the map's own points that agree with a frame's pose.

    searching  the camera may be anywhere: global relocalization
    following  the map holds the pose
    carried    it does not quite: temporary points carry the camera along, and the map around is searched beside

Source: science note B1.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class State(str, Enum):
    """See above."""

    searching = "searching"
    following = "following"
    carried = "carried"


class Step(Enum):
    """What a frame asks for.

    keep : nothing; enter : begin to carry; leave : the map is enough again; unsure : this frame has no pose that can be
    believed, the next one decides; lost : give up
    """

    keep = 0
    enter = 1
    leave = 2
    unsure = 3
    lost = 4


@dataclass(frozen=True)
class StatesConfig:
    """good_inliers (N1) : points of the map above which it holds the pose
    min_inliers (N2) : below, it does not, and without temporary points the camera is lost
    patience : frames in a row that it takes to leave `following`, or to be lost
    carried_inliers : points of both kinds with which a carried frame has a pose
    after_found_inliers : the same within after_found_s of having been found, until the map has held the pose
    max_carried_s, max_carried_m : how long drift is borne with
    max_guessed_m : the same, where all that is seen has no distance
    """

    good_inliers: int = 90
    min_inliers: int = 30
    patience: int = 2
    carried_inliers: int = 30
    after_found_inliers: int = 50
    after_found_s: float = 1.0
    max_carried_s: float = 60.0
    max_carried_m: float = 30.0
    max_guessed_m: float = 0.5


class States:
    """carrying : whether temporary points may be used; without, frames between N2 and N1 are followed all the same."""

    def __init__(self, config: StatesConfig, carrying: bool = True) -> None:
        self.config = config
        self.carrying = carrying
        self.state = State.searching
        self.why = ""
        self.poor = 0  # frames in a row below N1
        self.weak = 0  # frames in a row without a pose that can be believed
        self.carried_m = 0.0  # since the map last held the pose, if only just
        self.guessed_m = 0.0  # of it, without enough points whose distance is known
        self._reckoned = False
        self._doubted_ns: int | None = None  # when the camera was found, unless the map has held it since
        self._held_ns = 0  # when the map last held the pose, if only just

    def found(self, t_ns: int, in_map: int) -> None:
        """The camera was found; in_map : points of the map that agree with its pose."""
        self.state, self.why = State.following, ""
        held = in_map >= self.config.good_inliers
        self.poor, self.weak = int(not held), 0
        self._doubted_ns = None if held else t_ns

    def judge(
        self, t_ns: int, in_map: int, in_all: int, moved_m: float, guessed: bool = False, reckoned: bool = False
    ) -> Step:
        """What follows from a frame.

        in_map, in_all : points of the map, and of both kinds, that agree with its pose; moved_m : since the last frame
        guessed : how far it moved is, for want of points whose distance is known
        reckoned : an IMU says well where the camera is, so that frames may fail in any number
        """
        self._reckoned = reckoned
        if in_map >= self.config.good_inliers:
            self._doubted_ns = None
        if self.state is State.carried:
            return self._carried(t_ns, in_map, in_all, moved_m, guessed)
        c = self.config
        self.poor = 0 if in_map >= c.good_inliers else self.poor + 1
        if in_map < c.min_inliers:
            return self._unsure(f"{in_map} points of the map agree, {c.min_inliers} are needed")
        self.weak = 0
        self.why = f"{in_map} points of the map agree, fewer than {c.good_inliers}" if self.poor else ""
        if self.carrying and self.poor >= c.patience:
            self.state, self._held_ns, self.carried_m = State.carried, t_ns, 0.0
            self.guessed_m = 0.0
            return Step.enter
        return Step.keep

    def leave(self, why: str) -> None:
        """The map is enough again, found so beside the carried pose."""
        self.state, self.why = State.following, why
        self.poor = self.weak = 0

    def _carried(self, t_ns: int, in_map: int, in_all: int, moved_m: float, guessed: bool) -> Step:
        c = self.config
        if in_map >= c.min_inliers:
            self._held_ns, self.carried_m, self.guessed_m = t_ns, 0.0, 0.0
        else:
            self.carried_m += moved_m
            self.guessed_m += moved_m if guessed else 0.0
        if in_map >= c.good_inliers:
            self.leave("")
            return Step.leave
        early = self._doubted_ns is not None and (t_ns - self._doubted_ns) * 1e-9 < c.after_found_s
        needed = c.after_found_inliers if early else c.carried_inliers
        if in_all < needed:
            return self._unsure(f"{in_all} points agree, temporary ones counted in, {needed} are needed")
        carried_s = (t_ns - self._held_ns) * 1e-9
        if carried_s > c.max_carried_s or self.carried_m > c.max_carried_m:
            return self._lost(f"carried for {carried_s:.0f} s and {self.carried_m:.0f} m without the map")
        if self.guessed_m > c.max_guessed_m:
            return self._lost(f"carried for {self.guessed_m:.1f} m by points of which no distance is known")
        self.weak = 0
        self.why = (
            f"mono: {in_map} points of the map agree, fewer than {c.good_inliers}, and {in_all - in_map} temporary"
        )
        return Step.keep

    def _unsure(self, why: str) -> Step:
        self.weak += 1
        if self.weak >= self.config.patience and not self._reckoned:
            return self._lost(why)
        self.why = why
        return Step.unsure

    def _lost(self, why: str) -> Step:
        self.state, self.why = State.searching, why
        self.poor = self.weak = 0
        return Step.lost
