"""Which way is up, from an IMU: the gyro carries it on, the accelerometer slowly pulls it back.

A Kalman filter over up and the gyro's bias. Without the bias a part that is off by 0.02 rad/s when it is switched on,
as many are, holds up several degrees aside for good. Errors in the body's axes, w = gyro - bias:

    up' = -w x up,    e' = -w x e - [up]x db,    accel / g = up + e + what moves the body / g
"""

from __future__ import annotations

import math

import numpy as np

from lodelight.geometry.so3 import skew, so3_exp
from lodelight.messages import Imu
from lodelight.types import Array

GRAVITY, NEAR = 9.81, 1.0  # m/s^2; readings whose length is farther off say more of motion than of up
MOTION = 0.3  # m/s^2/sqrt(Hz): what steps, turns and starts come to over some seconds
GYRO_BIAS = 0.03  # rad/s, of a gyro that was just switched on
GYRO_NOISE, GYRO_WALK = 1e-3, 1e-4  # rad/s/sqrt(Hz), rad/s^2/sqrt(Hz): with what its scale and axes add
FIRST_RAD = 0.1  # of up by one sample alone
STEP_S = 0.05  # of samples that are taken together


class Leveller:
    """up_body : (3,) unit, None before the first sample; sigma_rad : of it, about either horizontal axis."""

    def __init__(self) -> None:
        self.up_body: Array | None = None
        self._bias = np.zeros(3)
        self._P: Array = np.diag([FIRST_RAD**2] * 3 + [GYRO_BIAS**2] * 3)
        self._t_ns = 0
        self._begin()

    def _begin(self) -> None:
        self._turn: Array = np.eye(3)
        self._force: Array = np.zeros(3)
        self._count, self._dt_s = 0, 0.0

    @property
    def sigma_rad(self) -> float:
        up = np.zeros(3) if self.up_body is None else self.up_body
        P = self._P[:3, :3]
        return math.sqrt(max(0.5 * float(np.trace(P) - up @ P @ up), 0.0))

    def feed(self, sample: Imu) -> None:
        """One sample, by rising stamp."""
        if self.up_body is None:
            norm = float(np.linalg.norm(sample.accel))
            if norm > 0.0:
                self.up_body, self._t_ns = sample.accel / norm, sample.t_ns
            return
        dt_s = (sample.t_ns - self._t_ns) * 1e-9
        if dt_s <= 0.0:
            return
        self._t_ns = sample.t_ns
        turn = so3_exp(-dt_s * (sample.gyro - self._bias))
        self.up_body = turn @ self.up_body
        self._turn = turn @ self._turn
        self._force = turn @ self._force + sample.accel  # along the body's axes of now
        self._count, self._dt_s = self._count + 1, self._dt_s + dt_s
        if self._dt_s >= STEP_S:
            self.up_body = self._updated(self.up_body)
            self._begin()

    def _updated(self, up: Array) -> Array:
        """Up, after what the samples since the last time say together."""
        F = np.eye(6)
        F[:3, :3] = self._turn
        F[:3, 3:] = -self._dt_s * skew(up)
        P = F @ self._P @ F.T + self._dt_s * np.diag([GYRO_NOISE**2] * 3 + [GYRO_WALK**2] * 3)
        force = self._force / self._count
        if abs(float(np.linalg.norm(force)) - GRAVITY) < NEAR:
            across = np.eye(3) - np.outer(up, up)  # its length says nothing of up
            H = np.hstack([across, np.zeros((3, 3))])
            S = H @ P @ H.T + (MOTION / GRAVITY) ** 2 / self._dt_s * np.eye(3)
            K = np.linalg.solve(S, H @ P).T
            e = K @ across @ force / GRAVITY
            P = P - K @ H @ P
            up, self._bias = up + e[:3], self._bias + e[3:]
        self._P = P
        out: Array = up / math.sqrt(float(up @ up))
        return out
