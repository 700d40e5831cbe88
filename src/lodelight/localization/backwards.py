"""Frames before a camera was found, followed back in time from where it was.

A camera that starts, or is lost, where a building has changed is found a while later, where it shows enough of what was
mapped. From there the same ladder that leads on leads back: by the map, and by temporary points made on the way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.localization.ladder import Ladder
from lodelight.localization.states import State
from lodelight.localization.tracked import Tracked
from lodelight.rig import Rig

MOST = 600  # frames that wait, the latest; some 90 kB each


class Backwards:
    """Frames that wait until the camera is found, and the way back through them.

    begin : makes a ladder for a rig, at its beginning
    created, left : temporary points that were made on the way, and those left in the end
    """

    def __init__(self, rig: Rig, begin: Callable[[Rig], Ladder]) -> None:
        self._begin = begin
        self._rig = mirrored(rig)
        self._waiting: deque[tuple[int, Features]] = deque(maxlen=MOST)
        self.created = self.left = 0

    def wait(self, t_ns: int, seen: Features) -> None:
        """A frame that has no pose yet."""
        self._waiting.append((t_ns, seen))

    def follow(self, found: Tracked) -> list[tuple[int, SE3]]:
        """(t_ns, T_world_body) of frames that waited, as far as the camera can be followed back from where it was
        found, the latest first. None waits any more."""
        waiting, poses = list(self._waiting), []
        self._waiting.clear()
        if not waiting:
            return []
        ladder = self._begin(self._rig)
        ladder.start(replace(found, temporary=None))
        for t_ns, seen in reversed(waiting):
            tracked = ladder.locate(2 * found.t_ns - t_ns, seen)
            if ladder.states.state is State.searching:
                break
            if not tracked.why_lost:
                poses.append((t_ns, tracked.T_world_body))
        ladder.close()
        self.created += ladder.temporary.created
        self.left += ladder.temporary_left
        return poses


def mirrored(rig: Rig) -> Rig:
    """The rig as it is when time runs backwards: the rows of a rolling shutter are read in the other order."""
    return replace(rig, cameras=tuple(replace(spec, row_time_s=-spec.row_time_s) for spec in rig.cameras))
