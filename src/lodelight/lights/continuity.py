"""May the lights be believed where the map says otherwise? If they agreed with it a moment ago, and made no jump since.

What moves in view carries tracking along in the course of some frames, while the lights go on as before; a light that
hangs elsewhere comes into view from one image to the next.
"""

from __future__ import annotations

import math

import numpy as np

from lodelight.geometry.se3 import SE3

HOLD_S = 1.0  # for how long they are believed after they last agreed
GAP_S = 0.25  # without a fix, after which they have to agree again
JUMP_M, JUMP_RAD = 0.12, math.radians(3.0)  # from where the motion of the last two fixes leads
NS = 1e-9


class Continuity:
    """Fed with every fix, by rising stamp, and with the times at which one agreed with the map."""

    def __init__(self) -> None:
        self._before: tuple[int, SE3] | None = None
        self._last: tuple[int, SE3] | None = None
        self._agreed_ns: int | None = None

    def fixed(self, t_ns: int, T_world_body: SE3) -> None:
        """A fix; where it jumps, or comes after a gap, nothing is believed until one agrees again."""
        if self._last is not None and self._jumps(t_ns, T_world_body):
            self._before = self._last = self._agreed_ns = None
        self._before, self._last = self._last, (t_ns, T_world_body)

    def agreed(self, t_ns: int) -> None:
        self._agreed_ns = t_ns

    def vouches(self, t_ns: int) -> bool:
        """Whether the fixes may be believed at a time, whatever the map says."""
        recent = self._last is not None and (t_ns - self._last[0]) * NS <= GAP_S
        return recent and self._agreed_ns is not None and (t_ns - self._agreed_ns) * NS <= HOLD_S

    def _jumps(self, t_ns: int, T_world_body: SE3) -> bool:
        assert self._last is not None
        last_ns, expected = self._last
        if (t_ns - last_ns) * NS > GAP_S:
            return True
        if self._before is None:
            return False
        before_ns, before = self._before
        share = (t_ns - last_ns) / max(last_ns - before_ns, 1)
        expected = expected @ SE3.exp(share * (before.inverse() @ expected).log())
        off = expected.inverse() @ T_world_body
        return bool(np.linalg.norm(off.t) > JUMP_M or off.angle > JUMP_RAD)
