"""Where an odometry's smooth frame lies in a map that does not come of it, as its last keyframes were found there."""

from __future__ import annotations

from collections import deque

import numpy as np

from lodelight.geometry.se3 import SE3, level
from lodelight.mapping.map import Map
from lodelight.types import Array

KEPT = 10  # keyframes, about what the odometry's window holds: between those its path is known best


class Berth:
    """A single keyframe is found to a centimetre or two, and wrongly now and then: the median of a few counts."""

    def __init__(self, map: Map) -> None:
        self._map = map
        self._found: deque[tuple[SE3, int, SE3]] = deque(maxlen=KEPT)

    def forget(self) -> None:
        """The odometry has begun anew."""
        self._found.clear()

    def add(self, T_map_body: SE3, reference: int, T_reference_body: SE3) -> SE3:
        """A keyframe in the odometry's frame, and beside the keyframe of the map where it was found.

        Returns T_world_map, a turn about z and a shift, that puts this keyframe where the median of the last has it.
        """
        self._found.append((T_map_body, reference, T_reference_body))
        pairs = [(inner, self._map.pose(near) @ outer) for inner, near, outer in self._found]
        told = [level(world @ inner.inverse(), inner.t) for inner, world in pairs]
        turns = [told[0].R.T @ T.R for T in told]
        yaw = float(np.median([np.arctan2(R[1, 0], R[0, 0]) for R in turns]))
        c, s = np.cos(yaw), np.sin(yaw)
        R: Array = told[0].R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        here = np.median([world.t + R @ (T_map_body.t - inner.t) for inner, world in pairs], axis=0)
        return SE3(R, here - R @ T_map_body.t)
