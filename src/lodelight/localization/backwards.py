"""Frames before a camera was found, followed back in time from where it was.

A camera that starts, or is lost, where a building has changed is found a while later, where it shows enough of what was
mapped. From there the same ladder that leads on leads back: by the map, and by temporary points made on the way.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.localization.ladder import Ladder
from lodelight.localization.states import State
from lodelight.localization.tracked import Tracked
from lodelight.rig import Rig

MOST = 600  # frames that wait, the latest; some 90 kB each
A_FRAME = 1  # of a way back, for each new one: so no frame takes longer than two
RUNWAY = 10  # frames after the one that was found, on which temporary points are made before the way back leaves them


class Backwards:
    """Frames that wait until the camera is found, and the way back through them.

    The frame in which it is found shows barely enough; a few later, or where the map holds the camera, it turns round.
    begin : makes a ladder for a rig, at its beginning
    good_inliers : points of the map above which it holds a camera
    created, left : temporary points that were made on the way, and those left in the end
    A way back goes on beside the frames that come, and its poses are there when it ends.
    """

    def __init__(self, rig: Rig, begin: Callable[[Rig], Ladder], good_inliers: int) -> None:
        self._begin = begin
        self._rig = mirrored(rig)
        self._good_inliers = good_inliers
        self._waiting: deque[tuple[int, Features, bool]] = deque(maxlen=MOST)  # whether it has a pose, too
        self._known: list[Tracked] = []  # frames since the camera was found
        self._ways: deque[Iterator[list[tuple[int, SE3]] | None]] = deque()
        self.created = self.left = 0

    def add(self, tracked: Tracked, seen: Features) -> list[tuple[int, SE3]]:
        """The next frame, and `seen` as the camera saw it.

        Returns (t_ns, T_world_body) of frames that waited, the latest first, where a way back to them ends with it.
        """
        lost = bool(tracked.why_lost)
        if lost:
            self._turn_round()
        if lost or self._waiting:
            self._waiting.append((tracked.t_ns, seen, not lost))
            self._known += [] if lost else [tracked]
        held = not lost and tracked.right_in_map >= self._good_inliers
        if held or len(self._known) > RUNWAY:
            self._turn_round()
        return self._go_on(A_FRAME)

    def follow(self) -> list[tuple[int, SE3]]:
        """As `add`, of all that waited: no frame comes any more."""
        self._turn_round()
        return self._go_on(math.inf)

    def _turn_round(self) -> None:
        """Begin the way back from the last frame that has a pose, if the camera was found since frames wait."""
        if self._known:
            self._ways.append(self._way(self._known[-1], list(self._waiting)))
            self._known.clear()
            self._waiting.clear()

    def _go_on(self, frames: float) -> list[tuple[int, SE3]]:
        poses: list[tuple[int, SE3]] = []
        while self._ways and frames > 0:
            done, frames = next(self._ways[0]), frames - 1
            if done is not None:
                poses += done
                self._ways.popleft()
        return poses

    def _way(self, found: Tracked, waiting: list[tuple[int, Features, bool]]) -> Iterator[list[tuple[int, SE3]] | None]:
        """Frame by frame as far as the camera can be followed back; at the end the poses of those that had none."""
        poses: list[tuple[int, SE3]] = []
        ladder = self._begin(self._rig)
        ladder.start(replace(found, temporary=None))
        for t_ns, seen, known in reversed(waiting[:-1]):
            tracked = ladder.locate(2 * found.t_ns - t_ns, seen)
            if ladder.states.state is State.searching:
                break
            if not (tracked.why_lost or known):
                poses.append((t_ns, tracked.T_world_body))
            yield None
        ladder.close()
        self.created += ladder.temporary.created
        self.left += ladder.temporary_left
        yield poses


def mirrored(rig: Rig) -> Rig:
    """The rig as it is when time runs backwards: the rows of a rolling shutter are read in the other order."""
    return replace(rig, cameras=tuple(replace(spec, row_time_s=-spec.row_time_s) for spec in rig.cameras))
