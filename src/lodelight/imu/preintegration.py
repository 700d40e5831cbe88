"""Inertial samples between two instants as one measurement, whatever the motion they start from.

Midpoint integration in the body frame of the first instant, with its covariance and its derivative to the biases.
Order of every vector: rotation, position, velocity, gyro bias, accelerometer bias. Derivation:
docs/derivations-inertial.md. Sources: science note C2; Forster et al., "On-manifold preintegration", 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import matmul
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import right_jacobian, skew, so3_exp, so3_perturbed
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec
from lodelight.types import Array

GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s^2, in every frame whose z points up
# A bias further than this from the one integrated with: integrate anew (science note C2).
MOVED_GYRO, MOVED_ACCEL = 0.01, 0.1
GAP_PERIODS = 2.5  # steps longer than so many sampling periods have lost samples
# Between samples that are missing, the signal is taken to wander at least so much: rad/s and m/s^2 per root second.
# A walking person and a drone measure 0.3 to 2 and 3 to 10 over 0.1 s.
WANDER_GYRO, WANDER_ACCEL = 1.0, 5.0


@dataclass(frozen=True, eq=False)
class NavState:
    """Where the body is, how it moves and how its IMU errs. v_world m/s; bias_gyro rad/s, bias_accel m/s^2."""

    t_ns: int
    T_world_body: SE3
    v_world: Array
    bias_gyro: Array
    bias_accel: Array

    def predicted(self, motion: Preintegration) -> NavState:
        """Carried on through `motion`, at this state's biases, under gravity along -z."""
        dR, dp, dv = motion.corrected(self.bias_gyro, self.bias_accel)
        R, T = self.T_world_body.R, motion.dt_s
        p = self.T_world_body.t + self.v_world * T + 0.5 * T * T * GRAVITY + R @ dp
        v = self.v_world + T * GRAVITY + R @ dv
        return NavState(motion.end_ns, SE3(so3_perturbed(matmul(R, dR), np.zeros(3)), p), v, *self.biases)

    @property
    def biases(self) -> tuple[Array, Array]:
        return self.bias_gyro, self.bias_accel


@dataclass(frozen=True, eq=False)
class Preintegration:
    """dR (3, 3), dp (3,) m, dv (3,) m/s : motion over dt_s without gravity and start velocity, in the first body frame.

    jacobian (9, 6) : of (rotation, dp, dv) to (gyro bias, accelerometer bias) around bias_gyro, bias_accel
    covariance (15, 15) : of what was integrated and of how far the biases wander meanwhile
    """

    samples: ImuSamples
    spec: ImuSpec
    bias_gyro: Array
    bias_accel: Array
    dR: Array
    dp: Array
    dv: Array
    jacobian: Array
    covariance: Array

    @property
    def start_ns(self) -> int:
        return int(self.samples.t_ns[0])

    @property
    def end_ns(self) -> int:
        return int(self.samples.t_ns[-1])

    @property
    def dt_s(self) -> float:
        return (self.end_ns - self.start_ns) * 1e-9

    def corrected(self, bias_gyro: Array, bias_accel: Array) -> tuple[Array, Array, Array]:
        """(dR, dp, dv) at other biases, to first order."""
        d = self.jacobian @ np.concatenate([bias_gyro - self.bias_gyro, bias_accel - self.bias_accel])
        return self.dR @ so3_exp(d[:3]), self.dp + d[3:6], self.dv + d[6:]

    def extended(self, later: ImuSamples) -> Preintegration:
        """Over `later` as well, which starts where this ends."""
        at = [np.array(a) for a in (self.dR, self.dp, self.dv, self.jacobian, self.covariance)]
        _run(later, self.spec, self.bias_gyro, self.bias_accel, at)
        return Preintegration(self.samples.joined(later), self.spec, self.bias_gyro, self.bias_accel, *at)

    def moved(self, bias_gyro: Array, bias_accel: Array) -> bool:
        """Whether these biases are too far off for `corrected`."""
        return bool(
            np.linalg.norm(bias_gyro - self.bias_gyro) > MOVED_GYRO
            or np.linalg.norm(bias_accel - self.bias_accel) > MOVED_ACCEL
        )

    def repropagated(self, bias_gyro: Array, bias_accel: Array) -> Preintegration:
        return preintegrate(self.samples, bias_gyro, bias_accel, self.spec)


def preintegrate(samples: ImuSamples, bias_gyro: Array, bias_accel: Array, spec: ImuSpec) -> Preintegration:
    """Integrate samples from the first to the last of them, at least two (see `ImuSamples.between`)."""
    at = [np.eye(3), np.zeros(3), np.zeros(3), np.zeros((9, 6)), np.zeros((15, 15))]
    bias_gyro, bias_accel = np.array(bias_gyro, np.float64), np.array(bias_accel, np.float64)
    _run(samples, spec, bias_gyro, bias_accel, at)
    return Preintegration(samples, spec, bias_gyro, bias_accel, *at)


def _run(samples: ImuSamples, spec: ImuSpec, bias_gyro: Array, bias_accel: Array, at: list[Array]) -> None:
    t_s = (samples.t_ns - samples.t_ns[0]) * 1e-9
    variances = np.array([spec.gyro_noise, spec.accel_noise, spec.gyro_walk, spec.accel_walk]) ** 2
    period = 1.0 / spec.rate_hz if spec.rate_hz > 0.0 else float(np.median(np.diff(t_s)))
    integrate(
        t_s, np.ascontiguousarray(samples.gyro), np.ascontiguousarray(samples.accel), bias_gyro, bias_accel,
        variances, GAP_PERIODS * period, *at,
    )  # fmt: skip


@kernel
def integrate(
    t_s: Array, gyro: Array, accel: Array, bias_gyro: Array, bias_accel: Array, variances: Array, gap_s: float,
    dR: Array, dp: Array, dv: Array, jacobian: Array, covariance: Array,
) -> None:  # fmt: skip
    """Carry dR .. covariance on, in place, over the steps between the samples.

    variances : squared densities of gyro noise, accelerometer noise, gyro walk, accelerometer walk
    """
    F = np.zeros((15, 15))
    FP, FJ, w = np.empty((15, 15)), np.empty((9, 6)), np.empty(3)
    a0, a1, a = np.empty(3), np.empty(3), np.empty(3)
    for i in range(15):
        F[i, i] = 1.0
    for k in range(len(t_s) - 1):
        dt = t_s[k + 1] - t_s[k]
        for i in range(3):
            w[i] = dt * (0.5 * (gyro[k, i] + gyro[k + 1, i]) - bias_gyro[i])
            a0[i] = accel[k, i] - bias_accel[i]
            a1[i] = accel[k + 1, i] - bias_accel[i]
        turn = so3_exp(w)
        Jw = right_jacobian(w)
        dR_next = matmul(dR, turn)
        L0, L1 = matmul(dR, skew(a0)), matmul(dR_next, skew(a1))
        for i in range(3):
            a[i] = 0.0
            for j in range(3):
                a[i] += 0.5 * (dR[i, j] * a0[j] + dR_next[i, j] * a1[j])
        # The transition F, by blocks of (theta, p, v, bg, ba); theta' = turn^T theta - Jw dt bg is put into v and p
        for i in range(3):
            F[3 + i, 6 + i] = dt
            for j in range(3):
                lever = L0[i, j]
                to_gyro = 0.0
                for m in range(3):
                    lever += L1[i, m] * turn[j, m]
                    to_gyro += L1[i, m] * Jw[m, j] * dt
                both = dR[i, j] + dR_next[i, j]
                F[i, j], F[i, 9 + j] = turn[j, i], -Jw[i, j] * dt
                F[3 + i, j], F[6 + i, j] = -0.25 * dt * dt * lever, -0.5 * dt * lever
                F[3 + i, 9 + j], F[6 + i, 9 + j] = 0.25 * dt * dt * to_gyro, 0.5 * dt * to_gyro
                F[3 + i, 12 + j], F[6 + i, 12 + j] = -0.25 * dt * dt * both, -0.5 * dt * both
        for i in range(9):
            for j in range(15):
                FP[i, j] = 0.0
            for j in range(6):
                FJ[i, j] = F[i, 9 + j]
            for m in range(15):
                f = F[i, m]
                if f != 0.0:
                    for j in range(15):
                        FP[i, j] += f * covariance[m, j]
                    if m < 9:
                        for j in range(6):
                            FJ[i, j] += f * jacobian[m, j]
        for i in range(9, 15):
            for j in range(15):
                FP[i, j] = covariance[i, j]
        for i in range(9):
            for j in range(6):
                jacobian[i, j] = FJ[i, j]
        for i in range(15):
            for j in range(i, 15):
                s = FP[i, j]
                if j < 9:
                    s = 0.0
                    for m in range(15):
                        s += FP[i, m] * F[j, m]
                covariance[i, j] = s
                covariance[j, i] = s
        _add_noise(dt, variances, L1, covariance)
        if dt > gap_s:
            change_gyro = change_accel = 0.0
            for i in range(3):
                change_gyro += (gyro[k + 1, i] - gyro[k, i]) ** 2 / (3.0 * dt)
                change_accel += (accel[k + 1, i] - accel[k, i]) ** 2 / (3.0 * dt)
            _add_gap(
                dt, max(change_gyro, WANDER_GYRO**2), max(change_accel, WANDER_ACCEL**2), dR_next, covariance
            )  # fmt: skip
        for i in range(3):
            dp[i] += dv[i] * dt + 0.5 * a[i] * dt * dt
            dv[i] += a[i] * dt
        w[:] = 0.0
        whole = so3_perturbed(dR_next, w)
        for i in range(3):
            for j in range(3):
                dR[i, j] = whole[i, j]


@kernel
def _add_noise(dt: float, variances: Array, L1: Array, P: Array) -> None:
    """White noise and walk of one step.

    Every sample serves two steps, half in each. Its noise in a step, sigma^2 / dt per sample, is therefore doubled, so
    that steps taken as independent add up to the variance of the sum.
    """
    gyro, accel, gyro_walk, accel_walk = variances
    for i in range(3):
        P[i, i] += gyro * dt
        P[3 + i, 3 + i] += 0.25 * accel * dt**3
        P[6 + i, 6 + i] += accel * dt
        P[3 + i, 6 + i] += 0.5 * accel * dt**2
        P[6 + i, 3 + i] += 0.5 * accel * dt**2
        P[9 + i, 9 + i] += gyro_walk * dt
        P[12 + i, 12 + i] += accel_walk * dt
        # the turn at the end of the step, uncertain by theta = dt n / 2, tilts half of its acceleration
        for j in range(3):
            tilt = -0.25 * dt * dt * gyro * L1[i, j]
            P[3 + i, j] += tilt * dt
            P[j, 3 + i] += tilt * dt
            P[6 + i, j] += 2.0 * tilt
            P[j, 6 + i] += 2.0 * tilt
            s = 0.0
            for m in range(3):
                s += L1[i, m] * L1[j, m]
            P[3 + i, 3 + j] += s * gyro * dt**5 / 16.0
            P[6 + i, 6 + j] += s * gyro * dt**3 / 4.0
            P[3 + i, 6 + j] += s * gyro * dt**4 / 8.0
            P[6 + i, 3 + j] += s * gyro * dt**4 / 8.0


@kernel
def _add_gap(dt: float, wander_gyro: float, wander_accel: float, R: Array, P: Array) -> None:
    """What a signal that wanders between two samples like a Brownian bridge adds to the straight line between them."""
    for i in range(3):
        P[i, i] += wander_gyro * dt**3 / 12.0
        P[6 + i, 6 + i] += wander_accel * dt**3 / 12.0
        P[3 + i, 6 + i] += wander_accel * dt**4 / 24.0
        P[6 + i, 3 + i] += wander_accel * dt**4 / 24.0
        P[3 + i, 3 + i] += wander_accel * dt**5 / 45.0
