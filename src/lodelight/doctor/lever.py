"""Where camera 0 sits on the IMU, in metres: what its motion by depth or a stereo pair and the accelerometer differ by.

Over two moments a, b, c in turn, free of the start's velocity, in the body's axes at a:

    (p_c - p_b) / T2 - (p_b - p_a) / T1 = g (T1 + T2) / 2 + dv_ab + dR_ab dp_bc / T2 - dp_ab / T1

with the accelerometer's preintegrated dR, dp, dv. The camera shows p up to where it sits, t: p = p_cam - R t. So the
lever tells itself where the turning changes, R_c - 2 R_b + R_a, and only there. Gravity is free in every stretch, the
accelerometer's bias in all, and the scale of the camera's metres is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lodelight.doctor.metric import Move
from lodelight.doctor.turning import Alignment
from lodelight.geometry.so3 import so3_exp
from lodelight.imu.preintegration import Preintegration, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.messages import Imu
from lodelight.rig import CameraSpec, ImuSpec
from lodelight.types import Array

LEAST_TRIPLES = 20
# How far off things may well be: lever m, bias m/s^2, scale; gravity is not known at all.
MAYBE = np.array([*[0.3] * 3, *[0.3] * 3, 0.05])
CORRELATED = 1.5  # neighbouring triples share a moment: what their sigma is to be multiplied by
ROUNDS = 12  # of reweighting


@dataclass(frozen=True, eq=False)
class Lever:
    """shift_m (3,) : true position of camera 0 on the body less the rig's; covariance (3, 3)."""

    shift_m: Array
    covariance: Array

    def told(self, sigma_m: float) -> tuple[float, float]:
        """The part of the shift along axes that are known to sigma_m, and its standard deviation."""
        values, axes = np.linalg.eigh(self.covariance)
        known = np.sqrt(values) < sigma_m
        if not known.any():
            return 0.0, float(np.sqrt(values[0]))
        along = axes[:, known].T @ self.shift_m
        length = float(np.linalg.norm(along))
        way = along / max(length, 1e-12)
        return length, float(np.sqrt(way**2 @ values[known]))


def lever_of(
    moves: Sequence[Move], imu: Sequence[Imu], spec: ImuSpec, cam0: CameraSpec, turning: Alignment
) -> Lever | None:
    """None where there are too few moments in a row to say anything.

    turning : how the gyro is biased, and what is to be added to the stamps of images
    """
    samples = ImuSamples(
        np.array([s.t_ns for s in imu], dtype=np.int64), np.array([s.gyro for s in imu]),
        np.array([s.accel for s in imu]),
    )  # fmt: skip
    shift_ns = round(turning.offset_s * 1e9)
    R_body_cam = cam0.T_body_cam.R @ so3_exp(turning.turn_rad)
    rows: list[tuple[Array, Array, int]] = []
    stretch, R_start = -1, np.eye(3)
    for i, (first, second) in enumerate(pairwise(moves)):
        if first.t_b != second.t_a:
            continue
        if i == 0 or stretch < 0 or moves[i - 1].t_b != first.t_a:
            stretch, R_start = stretch + 1, np.eye(3)
        parts = [_integrated(samples, m.t_a + shift_ns, m.t_b + shift_ns, turning.bias, spec) for m in (first, second)]
        if parts[0] is None or parts[1] is None:
            stretch = -1 if not rows else rows[-1][2]
            continue
        rows.append((*_triple(first, second, parts[0], parts[1], R_body_cam, cam0.T_body_cam.t, R_start), stretch))
        R_start = R_start @ parts[0].dR
    return _solved(rows) if len(rows) >= LEAST_TRIPLES else None


def _integrated(samples: ImuSamples, a_ns: int, b_ns: int, bias_gyro: Array, spec: ImuSpec) -> Preintegration | None:
    if a_ns < samples.t_ns[0] or b_ns > samples.t_ns[-1]:
        return None
    return preintegrate(samples.between(a_ns, b_ns), bias_gyro, np.zeros(3), spec)


def _triple(
    first: Move, second: Move, ab: Preintegration, bc: Preintegration, R_body_cam: Array, t: Array, R_start_a: Array
) -> tuple[Array, Array]:
    """A (3, 10), y (3,) of A x = y; x is the error of the lever, the bias, of scale, and the stretch's gravity."""
    T1, T2 = ab.dt_s, bc.dt_s
    moved_ab = R_body_cam @ first.T_a_b.t
    moved_bc = ab.dR @ R_body_cam @ second.T_a_b.t
    seen = moved_bc / T2 - moved_ab / T1
    turned = (ab.dR @ bc.dR - ab.dR) / T2 - (ab.dR - np.eye(3)) / T1
    said = ab.dv + ab.dR @ bc.dp / T2 - ab.dp / T1
    by_bias = ab.jacobian[6:9, 3:6] + ab.dR @ bc.jacobian[3:6, 3:6] / T2 - ab.jacobian[3:6, 3:6] / T1
    A = np.hstack([turned, by_bias, -seen[:, None], R_start_a.T * (0.5 * (T1 + T2))])
    return A, seen - turned @ t - said


def _solved(rows: Sequence[tuple[Array, Array, int]]) -> Lever:
    """Least squares with weights that outliers do not pass."""
    stretches = sorted({stretch for *_, stretch in rows})
    n = 7 + 3 * len(stretches)
    A, y = np.zeros((3 * len(rows), n)), np.concatenate([y for _, y, _ in rows])
    for i, (part, _, stretch) in enumerate(rows):
        at = 7 + 3 * stretches.index(stretch)
        A[3 * i : 3 * i + 3, :7], A[3 * i : 3 * i + 3, at : at + 3] = part[:, :7], part[:, 7:]
    prior = np.zeros(n)
    prior[:7] = 1.0 / MAYBE**2
    weight, spread, x = np.ones(len(y)), 1.0, np.zeros(n)
    for _ in range(ROUNDS):
        H = (A.T * weight) @ A / spread**2 + np.diag(prior)
        x = np.linalg.solve(H, (A.T * weight) @ y / spread**2)
        miss = np.linalg.norm((y - A @ x).reshape(-1, 3), axis=1)
        spread = max(float(np.median(miss)) / 1.54, 1e-4)  # the median of three normal coordinates' length
        weight = np.repeat(1.0 / (1.0 + (miss / (2.5 * spread)) ** 2) ** 2, 3)
    return Lever(x[:3], CORRELATED**2 * np.linalg.inv(H)[:3, :3])
