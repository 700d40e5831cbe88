"""The states of localization: initializing, tracking, degraded, lost, relocalized; each change with its reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex
from lodelight.geometry.se3 import SE3
from lodelight.localization.tracker import Tracked, Tracker
from lodelight.messages import Doubt, Status
from lodelight.types import Array, Ints


@dataclass(frozen=True, eq=False)
class Found:
    """Where a frame was found without knowing where it was before. point : (N,) map point of every feature, or -1."""

    T_world_body: SE3
    covariance: Array
    point: Ints
    why: str


Finder = Callable[[Features], "Found | str"]
# Told a stamp and T_world_body as tracked (None where it was lost): where to look again, None where that will do.
Elsewhere = Callable[[int, "SE3 | None"], "Doubt | None"]


class LocalizationMachine:
    """Follows the camera with the tracker, and finds it again with `find` when it was lost."""

    def __init__(self, tracker: Tracker, find: Finder) -> None:
        self.tracker = tracker
        self._find = find
        self.status: Status = "initializing"
        self.why = "no map yet"

    def start(self, tracked: Tracked) -> None:
        """The first frame of a new map: its pose is given, not estimated."""
        self.tracker.accept(tracked)
        self.status, self.why = "tracking", "the map begins here"

    def locate(self, t_ns: int, seen: Features, elsewhere: Elsewhere | None = None) -> Tracked:
        """Pose of a frame in the map; `status` and `why` say how it was had, or why not.

        elsewhere : an anchor of the building that doubts what was tracked, and says where to look again
        """
        tracked = None
        if self.status in ("tracking", "degraded", "relocalized"):
            tracked = self.tracker.track(t_ns, seen)
        if elsewhere is not None and self.status != "initializing":
            tracked = self._second_look(t_ns, seen, tracked, elsewhere)
        if tracked is None or tracked.why_lost:
            tracked = self._relocalize(t_ns, seen, tracked)
        else:
            found = self.status == "lost"  # by where the anchor said
            good = self.tracker.config.good_inliers
            few = tracked.n_inliers < good
            self.status = "degraded" if few else "tracking"
            self.why = f"{tracked.n_inliers} inliers, fewer than {good}" if few else ""
            if tracked.n_inliers == 0:
                self.why = "what is in view moves, says an anchor of the building"
            elif found:
                self.status, self.why = "relocalized", "found where an anchor of the building said"
        self.tracker.accept(tracked)
        return tracked

    def _second_look(self, t_ns: int, seen: Features, first: Tracked | None, elsewhere: Elsewhere) -> Tracked | None:
        """What is found where an anchor says, if there is enough of it and the anchor is content.

        Else a sure anchor's own pose, with nothing that was matched; else the first.
        """
        doubt = elsewhere(t_ns, None if first is None or first.why_lost else first.T_world_body)
        if doubt is None:
            return first
        second = self.tracker.track_at(t_ns, seen, doubt.T_world_body)
        enough = second.n_inliers >= self.tracker.config.good_inliers
        if enough and elsewhere(t_ns, second.T_world_body) is None:
            return second
        if not doubt.sure:
            return first
        nothing = np.full(len(seen), -1, np.int32)
        return Tracked(t_ns, second.seen, doubt.T_world_body, doubt.covariance, nothing, second.reference)

    def _relocalize(self, t_ns: int, seen: Features, failed: Tracked | None) -> Tracked:
        found = self._find(seen)
        if isinstance(found, str):
            if self.status != "initializing":
                self.status = "lost"
            self.why = "; ".join(filter(None, [failed.why_lost if failed else "", found]))
            return failed if failed is not None else self._nowhere(t_ns, seen)
        index = FeatureIndex(seen, self.tracker.camera.width, self.tracker.camera.height)
        tracked = self.tracker.refine(t_ns, seen, found.T_world_body, found.point, index, search=5.0)
        if tracked.why_lost:
            self.status, self.why = "lost", f"found, but {tracked.why_lost}"
        else:
            self.status, self.why = "relocalized", found.why
        return tracked

    def _nowhere(self, t_ns: int, seen: Features) -> Tracked:
        """A frame without a pose: where the camera was last, known no better than the building."""
        last = self.tracker.last
        where = last.T_world_body if last else SE3.identity()
        nothing = np.full(len(seen), -1, np.int32)
        return Tracked(t_ns, seen, where, np.eye(6), nothing, last.reference if last else 0, why_lost="lost")
