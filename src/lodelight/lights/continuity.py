"""May the lights be believed where the map says otherwise? If they agreed with it a moment ago, and made no jump since.

What moves in view carries tracking along in the course of some frames, while the lights go on as before; a light that
hangs elsewhere comes into view from one image to the next. Fixes share their largest errors, of up and of the survey,
for seconds: their motion is known far better than their place, so it is their motion since then that is believed.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from lodelight.geometry.se3 import SE3

HOLD_S = 1.0  # for how long they are believed after they last agreed
GAP_S = 0.25  # without a fix, after which they have to agree again
JUMP_M, JUMP_RAD = 0.12, math.radians(3.0)  # from where the motion of the last two fixes leads
NS = 1e-9


class Continuity:
    """Fed with every fix, by rising stamp, and with what the map says at the time of those that agree with it."""

    def __init__(self) -> None:
        self._fixes: deque[tuple[int, SE3]] = deque(maxlen=2)
        self._agreed: deque[tuple[int, SE3]] = deque()  # T_light_body: how the map's pose lay off the lights' then

    def fixed(self, t_ns: int, T_world_body: SE3) -> None:
        """A fix; where it jumps, or comes after a gap, nothing is believed until one agrees again."""
        if self._jumps(t_ns, T_world_body):
            self.forget()
        self._fixes.append((t_ns, T_world_body))

    def agreed(self, t_ns: int, T_world_light: SE3, T_world_body: SE3) -> None:
        """The body by the lights and in the map at one time, near each other."""
        self._agreed.append((t_ns, T_world_light.inverse() @ T_world_body))

    def forget(self) -> None:
        self._fixes.clear()
        self._agreed.clear()

    def expected(self, t_ns: int, T_world_light: SE3) -> SE3 | None:
        """Where the map should have the body, by the lights' motion since they agreed; None where that is long ago.

        Since the first time within HOLD_S: tracking that is carried along a little from fix to fix shows as well.
        """
        while self._agreed and (t_ns - self._agreed[0][0]) * NS > HOLD_S:
            self._agreed.popleft()
        if not self._agreed or not self._fixes or (t_ns - self._fixes[-1][0]) * NS > GAP_S:
            return None
        return T_world_light @ self._agreed[0][1]

    def _jumps(self, t_ns: int, T_world_body: SE3) -> bool:
        if not self._fixes:
            return False
        last_ns, expected = self._fixes[-1]
        if (t_ns - last_ns) * NS > GAP_S:
            return True
        if len(self._fixes) < 2:
            return False
        before_ns, before = self._fixes[0]
        share = (t_ns - last_ns) / max(last_ns - before_ns, 1)
        expected = expected @ SE3.exp(share * (before.inverse() @ expected).log())
        off = expected.inverse() @ T_world_body
        return bool(np.linalg.norm(off.t) > JUMP_M or off.angle > JUMP_RAD)
