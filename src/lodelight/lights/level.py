"""Which way is up, from an IMU: the gyro carries it on, the accelerometer slowly pulls it back."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.so3 import so3_exp
from lodelight.messages import Imu
from lodelight.types import Array

SETTLING_S = 4.0  # longer than the accelerations of steps and turns, shorter than a gyro's drift to a degree
GRAVITY, NEAR = 9.81, 1.0  # m/s^2; readings whose length is farther off say more of motion than of up


@dataclass(eq=False)
class Leveller:
    """A complementary filter (Mahony et al. 2008). up_body : (3,) unit, None before the first sample."""

    up_body: Array | None = field(default=None, init=False)
    _t_ns: int = field(default=0, init=False)
    _age_s: float = field(default=0.0, init=False)

    def feed(self, sample: Imu) -> None:
        norm = float(np.linalg.norm(sample.accel))
        if self.up_body is None:
            if norm > 0.0:
                self.up_body, self._t_ns = sample.accel / norm, sample.t_ns
            return
        dt_s = (sample.t_ns - self._t_ns) * 1e-9
        if dt_s <= 0.0:
            return
        self._t_ns = sample.t_ns
        self._age_s += dt_s
        up = so3_exp(-dt_s * sample.gyro) @ self.up_body
        if abs(norm - GRAVITY) < NEAR:
            up = up + dt_s / min(SETTLING_S, self._age_s) * (sample.accel / norm - up)
        self.up_body = up / math.sqrt(float(up @ up))
