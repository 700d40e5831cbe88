"""The states of localization: initializing, tracking, degraded, lost, relocalized; each change with its reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lodelight.features.features import Features
from lodelight.features.matching import FeatureIndex
from lodelight.geometry.se3 import SE3
from lodelight.localization.tracker import Tracked, Tracker
from lodelight.messages import Status
from lodelight.types import Array, Ints


@dataclass(frozen=True, eq=False)
class Found:
    """Where a frame was found without knowing where it was before. point : (N,) map point of every feature, or -1."""

    T_world_body: SE3
    covariance: Array
    point: Ints
    why: str


Finder = Callable[[Features], "Found | str"]


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

    def locate(self, t_ns: int, seen: Features) -> Tracked:
        """Pose of a frame in the map; `status` and `why` say how it was had, or why not."""
        tracked = None
        if self.status in ("tracking", "degraded", "relocalized"):
            tracked = self.tracker.track(t_ns, seen)
        if tracked is None or tracked.why_lost:
            tracked = self._relocalize(t_ns, seen, tracked)
        else:
            good = self.tracker.config.good_inliers
            few = tracked.n_inliers < good
            self.status = "degraded" if few else "tracking"
            self.why = f"{tracked.n_inliers} inliers, fewer than {good}" if few else ""
        self.tracker.accept(tracked)
        return tracked

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
