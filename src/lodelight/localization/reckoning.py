"""How the body goes on from its last pose in the map, by its IMU: between two frames, in a blur, in the dark.

A Kalman filter of the errors of rotation (body frame), position, velocity, both biases and gravity. Gravity is a state
like the others, as the z axis of a map that was made without an IMU points anywhere. Poses in the map are its only
measurements. Sources: science note C2; Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, ch. 5, 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew, so3_log
from lodelight.imu.preintegration import GRAVITY, preintegrate
from lodelight.imu.stream import EventSink, ImuStream
from lodelight.messages import Imu
from lodelight.rig import ImuSpec
from lodelight.types import Array

SPEED, GYRO_BIAS, ACCEL_BIAS = 1.0, 0.1, 0.3  # standard deviations of what is not known yet: m/s, rad/s, m/s^2
SHAKING = 2.0  # m/s^2, of what a body does beside lying still
ONE_G = 0.02  # m/s^2, by how much gravity differs between places on Earth
POSE_SIGMAS = 2.0  # errors of poses over what corners say of them: those of the map change as points come and go
JUMP_CHI2 = 22.5  # 99.9 % of a chi-square with 6 degrees of freedom
RESTING_NS = 200_000_000  # over which an accelerometer's mean is mostly gravity
KNOWN_GRAVITY = 0.3  # m/s^2, one standard deviation, from which its direction counts as known
ROTATION, POSITION, VELOCITY, GYRO, ACCEL, DOWN = (slice(i, i + 3) for i in range(0, 18, 3))


@dataclass(frozen=True, eq=False)
class Reckoned:
    """Where the body should be. covariance : (6, 6), chart of SE3.perturbed"""

    t_ns: int
    T_map_body: SE3
    covariance: Array

    @property
    def sigma_m(self) -> float:
        """Of the position, in the direction where least is known of it."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))


class DeadReckoning:
    """Follows the body from `begin` on; `predict` carries it on to a frame, `correct` says where that was."""

    def __init__(self, spec: ImuSpec, on_event: EventSink | None = None) -> None:
        self.spec = spec
        self._stream = ImuStream(spec, on_event)
        self._t_ns: int | None = None
        self._T = SE3.identity()
        self._v = np.zeros(3)
        self._bias_gyro, self._bias_accel = np.zeros(3), np.zeros(3)
        self._gravity: Array | None = None
        self._P = np.diag(np.repeat([1.0, 1.0, SPEED, GYRO_BIAS, ACCEL_BIAS, SHAKING], 3) ** 2)

    @property
    def bias_gyro(self) -> Array:
        """(3,) rad/s as believed now."""
        return self._bias_gyro

    def add(self, sample: Imu) -> None:
        """The next sample; bad ones are left out and told."""
        self._stream.add(sample)

    def begin(self, t_ns: int, T_map_body: SE3, covariance: Array) -> None:
        """The body was found there, moving nobody knows how; of biases and gravity stays known what was."""
        force = self._force(t_ns)
        if force is None:
            self._t_ns = None
            return
        if self._gravity is None:
            self._gravity = T_map_body.R @ force * (GRAVITY[2] / float(np.linalg.norm(force)))
        self._t_ns, self._T, self._v = t_ns, T_map_body, np.zeros(3)
        P = np.zeros_like(self._P)
        P[9:, 9:] = self._P[9:, 9:]
        P[:6, :6], P[VELOCITY, VELOCITY] = POSE_SIGMAS**2 * covariance, SPEED**2 * np.eye(3)
        self._P = P

    def predict(self, t_ns: int) -> Reckoned | None:
        """Where the body is at t_ns; None where it was not followed, or samples are missing."""
        if self._t_ns is None or self._gravity is None or t_ns < self._t_ns:
            return None
        if t_ns > self._t_ns and not self._carry(t_ns, self._gravity):
            self._t_ns = None
            return None
        return Reckoned(t_ns, self._T, self._P[:6, :6].copy())

    def correct(self, t_ns: int, T_map_body: SE3, covariance: Array) -> None:
        """The pose of the frame that was predicted last, found without the IMU."""
        if self._t_ns != t_ns or self._gravity is None:
            return self.begin(t_ns, T_map_body, covariance)
        r = np.concatenate([so3_log(np.ascontiguousarray(self._T.R.T @ T_map_body.R)), T_map_body.t - self._T.t])
        noise = POSE_SIGMAS**2 * covariance
        if r @ np.linalg.solve(self._P[:6, :6] + noise, r) > JUMP_CHI2:  # it was taken for somewhere else
            return self.begin(t_ns, T_map_body, covariance)
        self._update(np.eye(6, 18), r, noise)
        length = float(np.linalg.norm(self._gravity))
        row = np.zeros((1, 18))
        row[0, DOWN] = self._gravity / length
        self._update(row, np.array([-GRAVITY[2] - length]), np.array([[ONE_G**2]]))
        return None

    def tipped_deg(self, t_ns: int, T_map_body: SE3) -> float:
        """How far a pose stands off the vertical that the accelerometer shows; 0 where nothing is known of either."""
        known = self._gravity is not None and np.sqrt(np.linalg.eigvalsh(self._P[DOWN, DOWN])[-1]) < KNOWN_GRAVITY
        force = self._force(t_ns) if known else None
        if force is None or self._gravity is None:
            return 0.0
        cosine = -self._gravity @ T_map_body.R @ force / (np.linalg.norm(self._gravity) * np.linalg.norm(force))
        return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    # -- parts --------------------------------------------------------------------------------------------------

    def _force(self, t_ns: int) -> Array | None:
        """(3,) m/s^2, the accelerometer's mean before t_ns; None where it has shown nothing, or nothing but rest."""
        samples = self._stream.between(t_ns - RESTING_NS, t_ns)
        if isinstance(samples, str):
            return None
        mean: Array = samples.accel.mean(axis=0)
        return mean if np.linalg.norm(mean) > SHAKING else None

    def _carry(self, t_ns: int, gravity: Array) -> bool:
        assert self._t_ns is not None
        samples = self._stream.between(self._t_ns, t_ns)
        if isinstance(samples, str):
            return False
        self._stream.forget_before(t_ns - RESTING_NS)
        motion = preintegrate(samples, self._bias_gyro, self._bias_accel, self.spec)
        R, T, J = self._T.R, motion.dt_s, motion.jacobian
        F = np.eye(18)
        F[ROTATION, ROTATION], F[ROTATION, GYRO] = motion.dR.T, J[:3, :3]
        F[POSITION, ROTATION], F[VELOCITY, ROTATION] = -R @ skew(motion.dp), -R @ skew(motion.dv)
        F[POSITION, VELOCITY] = T * np.eye(3)
        F[POSITION, GYRO], F[POSITION, ACCEL] = R @ J[3:6, :3], R @ J[3:6, 3:]
        F[VELOCITY, GYRO], F[VELOCITY, ACCEL] = R @ J[6:, :3], R @ J[6:, 3:]
        F[POSITION, DOWN], F[VELOCITY, DOWN] = 0.5 * T * T * np.eye(3), T * np.eye(3)
        turned = np.eye(15)
        turned[3:6, 3:6] = turned[6:9, 6:9] = R
        self._P = F @ self._P @ F.T
        self._P[:15, :15] += turned @ motion.covariance @ turned.T
        self._T = SE3(R @ motion.dR, self._T.t + T * self._v + 0.5 * T * T * gravity + R @ motion.dp)
        self._v = self._v + T * gravity + R @ motion.dv
        self._t_ns = t_ns
        return True

    def _update(self, H: Array, r: Array, noise: Array) -> None:
        gain = self._P @ H.T @ np.linalg.inv(H @ self._P @ H.T + noise)
        rest = np.eye(18) - gain @ H
        self._P = rest @ self._P @ rest.T + gain @ noise @ gain.T
        d = gain @ r
        self._T = self._T.perturbed(d[:6])
        self._v = self._v + d[VELOCITY]
        self._bias_gyro, self._bias_accel = self._bias_gyro + d[GYRO], self._bias_accel + d[ACCEL]
        if self._gravity is not None:
            self._gravity = self._gravity + d[DOWN]
