"""What REP 105 asks for: map -> odom -> base_link, with odom smooth and map right."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.types import Array


@dataclass(eq=False)
class OdomFrame:
    """Poses by the map, as a smooth motion and a correction of it.

    The odometry goes on by the motion between frames as the map has it now; so a loop, an alignment or a relocalization
    moves `T_map_odom` and leaves a robot's odometry where it was.
    """

    T_map_odom: SE3 = field(default_factory=SE3.identity)
    T_odom_base: SE3 = field(default_factory=SE3.identity)
    velocity: Array = field(default_factory=lambda: np.zeros(6))  # (6,) m/s, rad/s, in base_link
    _t_ns: int | None = None

    def update(self, t_ns: int, T_map_base: SE3, T_map_before: SE3 | None) -> None:
        """T_map_before : where the map has base_link at the last update, as it stands now; None where it lost it."""
        if self._t_ns is None:  # the odometry begins where the map does
            self.T_odom_base = T_map_base
        elif T_map_before is None:
            self.velocity = np.zeros(6)
        else:
            moved = T_map_before.inverse() @ T_map_base
            self.T_odom_base = self.T_odom_base @ moved
            dt_s = max((t_ns - self._t_ns) * 1e-9, 1e-6)
            turn = moved.log()[:3]
            self.velocity = np.concatenate([moved.t, turn]) / dt_s
        self.T_map_odom = T_map_base @ self.T_odom_base.inverse()
        self._t_ns = t_ns
