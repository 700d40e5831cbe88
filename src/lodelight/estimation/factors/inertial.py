"""Two states and the IMU between them: 15 residuals.

    r_theta = Log(dR^T R_i^T R_j)                          r_bg = bg_j - bg_i
    r_p = R_i^T (p_j - p_i - v_i T - g T^2 / 2) - dp       r_ba = ba_j - ba_i
    r_v = R_i^T (v_j - v_i - g T) - dv

dR, dp, dv are corrected to first order for the biases of i. A state is a row x (21,) = R by rows, p, v, bg, ba; its
chart (theta, p, v, bg, ba). Derivation: docs/derivations-inertial.md. Source: science note C3.
"""

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import matmul, transposed
from lodelight.geometry.so3 import right_jacobian, right_jacobian_inverse, so3_exp, so3_log
from lodelight.types import Array

GRAVITY_Z = -9.81
P, V, BG, BA, STATE = 9, 12, 15, 18, 21  # where a state's parts are in its row
# Where the parts of a preintegrated measurement are in its row
DR, DP, DV, JACOBIAN, BIAS, DT, MEASUREMENT = 0, 9, 12, 15, 69, 75, 76


@kernel
def rotation_of(x: Array) -> Array:
    R = np.empty((3, 3))
    for i in range(9):
        R[i // 3, i % 3] = x[i]
    return R


@kernel
def inertial_residual(xi: Array, xj: Array, measured: Array, r: Array) -> None:
    """Fill r (15,), not whitened, of states x (21,) and a measurement (76,)."""
    T = measured[DT]
    Ri, Rj = rotation_of(xi), rotation_of(xj)
    bias = np.empty(6)
    for a in range(6):
        bias[a] = xi[BG + a] - measured[BIAS + a]
    correction = np.zeros(9)
    for a in range(9):
        for b in range(6):
            correction[a] += measured[JACOBIAN + 6 * a + b] * bias[b]
    dR = matmul(rotation_of(measured), so3_exp(correction[:3]))
    w = so3_log(matmul(transposed(dR), matmul(transposed(Ri), Rj)))
    dp, dv = np.empty(3), np.empty(3)
    for a in range(3):
        fall = GRAVITY_Z if a == 2 else 0.0
        dp[a] = xj[P + a] - xi[P + a] - xi[V + a] * T - 0.5 * fall * T * T
        dv[a] = xj[V + a] - xi[V + a] - fall * T
    for a in range(3):
        r[a] = w[a]
        r[3 + a], r[6 + a] = -measured[DP + a] - correction[3 + a], -measured[DV + a] - correction[6 + a]
        for b in range(3):
            r[3 + a] += Ri[b, a] * dp[b]
            r[6 + a] += Ri[b, a] * dv[b]
        r[9 + a] = xj[BG + a] - xi[BG + a]
        r[12 + a] = xj[BA + a] - xi[BA + a]


@kernel
def inertial_jacobian(xi: Array, xj: Array, measured: Array, r: Array, J: Array) -> None:
    """Fill J (15, 30) = d r / d (state i, state j), given r at these states."""
    T = measured[DT]
    Ri, Rj = rotation_of(xi), rotation_of(xj)
    J[:] = 0.0
    turned = matmul(transposed(Rj), Ri)
    inverse = right_jacobian_inverse(r[:3])
    to_i = matmul(inverse, turned)
    correction = np.zeros(3)
    to_gyro = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            to_gyro[a, b] = measured[JACOBIAN + 6 * a + b]
            correction[a] += to_gyro[a, b] * (xi[BG + b] - measured[BIAS + b])
    to_bias = matmul(
        matmul(inverse, transposed(so3_exp(r[:3]))), matmul(right_jacobian(correction), to_gyro)
    )  # fmt: skip
    dp, dv = np.zeros(3), np.zeros(3)
    for a in range(3):
        fall = GRAVITY_Z if a == 2 else 0.0
        p = xj[P + a] - xi[P + a] - xi[V + a] * T - 0.5 * fall * T * T
        v = xj[V + a] - xi[V + a] - fall * T
        for b in range(3):
            dp[b] += Ri[a, b] * p
            dv[b] += Ri[a, b] * v
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        J[3 + a, b], J[3 + a, c] = -dp[c], dp[b]  # [dp]x
        J[6 + a, b], J[6 + a, c] = -dv[c], dv[b]
        J[9 + a, 9 + a], J[9 + a, 24 + a] = -1.0, 1.0
        J[12 + a, 12 + a], J[12 + a, 27 + a] = -1.0, 1.0
        for b in range(3):
            J[a, b], J[a, 15 + b], J[a, 9 + b] = -to_i[a, b], inverse[a, b], -to_bias[a, b]
            J[3 + a, 3 + b], J[3 + a, 18 + b], J[3 + a, 6 + b] = -Ri[b, a], Ri[b, a], -T * Ri[b, a]
            J[6 + a, 6 + b], J[6 + a, 21 + b] = -Ri[b, a], Ri[b, a]
        for b in range(6):
            J[3 + a, 9 + b] = -measured[JACOBIAN + 6 * (3 + a) + b]
            J[6 + a, 9 + b] = -measured[JACOBIAN + 6 * (6 + a) + b]
