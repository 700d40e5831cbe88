"""A camera that may be anywhere: where it is looked for, and the second look before it is believed to be there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lodelight.features.features import Features
from lodelight.localization.follower import Follower
from lodelight.localization.machine import Found
from lodelight.localization.reckoning import DeadReckoning
from lodelight.localization.relocalize import Hint, Relocalizer
from lodelight.localization.tracker import Tracked

HINT_S = 2.0  # after which nothing is left of what was known of a place
TIPPED_DEG = 30.0  # off the vertical: an accelerometer that shakes is off by less


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


@dataclass(frozen=True, eq=False)
class Believed:
    """A frame that was found. waited : earlier ones, found by too few points to be believed until this one agreed"""

    tracked: Tracked
    why: str
    waited: list[Tracked]


class SecondLook:
    """Finds frames, and looks again at what it finds.

    min_inliers : points of the map without which no frame has a pose; reckoning : by an IMU, None without one
    hint : what others say of the camera's place, and when they did
    known : where it was lost, and when
    """

    def __init__(
        self, follower: Follower, relocalizer: Relocalizer, config: SecondLookConfig, min_inliers: int,
        reckoning: DeadReckoning | None,
    ) -> None:  # fmt: skip
        self.config = config
        self.hint: tuple[int, Hint] | None = None
        self.known: tuple[int, Hint] | None = None
        self._follower = follower
        self._relocalizer = relocalizer
        self._min_inliers = min_inliers
        self._reckoning = reckoning
        self._pending: list[Tracked] = []  # an answer that waits for another that agrees

    def lost(self, last: Tracked, carried_m: float) -> None:
        """The camera is not where it was followed to any more; carried_m : its way without the map until then"""
        self.known = (last.t_ns, Hint(last.T_world_body, self.config.reach_m + self.config.drift * carried_m))

    def find(self, t_ns: int, seen: Features) -> Believed | str:
        """A frame in the map with little or nothing known of where it is, or why it is not believed to be anywhere."""
        found = self._find(t_ns, seen)
        if isinstance(found, str):
            return found
        tracked = self._follower.by_map_alone(t_ns, seen, found.T_world_body, found.point)
        if tracked.why_lost or tracked.right_in_map < self._min_inliers:
            return f"{found.why}, but {tracked.right_in_map} on a second look"
        tipped_deg = self._reckoning.tipped_deg(t_ns, tracked.T_world_body) if self._reckoning is not None else 0.0
        if tipped_deg > TIPPED_DEG:
            return f"{found.why}, but {tipped_deg:.0f} degrees off the vertical"
        waited: list[Tracked] = []
        if tracked.right_in_map < self.config.inliers:
            if not self._pending or not self.explained(self._pending[-1], tracked):
                self._pending = [tracked]
                return f"{found.why}, too few to be believed before it is found again"
            waited = self._pending
        self._pending, self.known = [], None
        return Believed(tracked, f"{found.why}; {tracked.right_in_map} on a second look", waited)

    def explained(self, before: Tracked, now: Tracked) -> bool:
        """Whether a camera can have moved from one frame's pose to the next one's, in the time it had."""
        look = self.config
        dt_s = (now.t_ns - before.t_ns) * 1e-9
        apart = before.T_world_body.inverse() @ now.T_world_body
        soon = dt_s <= look.patience_s
        near = float(np.linalg.norm(apart.t)) <= 0.1 + look.speed_m_s * dt_s
        return bool(soon and near and np.degrees(apart.angle) <= 5.0 + look.speed_deg_s * dt_s)

    def _find(self, t_ns: int, seen: Features) -> Found | str:
        """By what was told of the place, if anything; else around the last pose while it is fresh, then anywhere."""
        for known, alone in ((self.hint, True), (self._last_known(), False)):
            if known is None or (t_ns - known[0]) * 1e-9 > HINT_S:
                continue
            age_s = abs(t_ns - known[0]) * 1e-9
            hint = replace(known[1], radius_m=known[1].radius_m + self.config.speed_m_s * age_s)
            found = self._relocalizer.find(seen, hint)
            if alone or isinstance(found, Found):
                return found
        return self._relocalizer.find(seen)

    def _last_known(self) -> tuple[int, Hint] | None:
        """Where the camera was last, or is by its IMU."""
        last, reckoned, reach_m = self._follower.last, self._follower.reckoned, self.config.reach_m
        if reckoned is not None and reckoned.sigma_m < reach_m:
            return reckoned.t_ns, Hint(reckoned.T_map_body, reach_m, reckoned.covariance)
        if last is None:
            return self.known
        return last.t_ns, Hint(last.T_world_body, reach_m)
