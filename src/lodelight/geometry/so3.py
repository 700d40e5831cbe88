"""Rotations: exponential, logarithm, Jacobians, quaternions. Right perturbation, R <- R Exp(w).

Compiled, and callable from kernels and from Python alike.
Source: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.
"""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import matmul
from lodelight.types import Array


@kernel
def skew(v: Array) -> Array:
    """[v]x (3, 3), so that skew(v) @ u == cross(v, u)."""
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2] = -v[2], v[1]
    out[1, 0], out[1, 2] = v[2], -v[0]
    out[2, 0], out[2, 1] = -v[1], v[0]
    return out


@kernel
def so3_exp(w: Array) -> Array:
    """Rotation matrix (3, 3) of the rotation vector w (3,) rad."""
    theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if theta2 < 1e-12:
        a = 1.0 - theta2 / 6.0
        b = 0.5 - theta2 / 24.0
    else:
        theta = math.sqrt(theta2)
        a = math.sin(theta) / theta
        b = (1.0 - math.cos(theta)) / theta2
    x, y, z = w[0], w[1], w[2]
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[2, 2] = 1.0 - b * (x * x + y * y)
    out[0, 1] = b * x * y - a * z
    out[1, 0] = b * x * y + a * z
    out[0, 2] = b * x * z + a * y
    out[2, 0] = b * x * z - a * y
    out[1, 2] = b * y * z - a * x
    out[2, 1] = b * y * z + a * x
    return out


@kernel
def quat_wxyz_from_matrix(R: Array) -> Array:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix; stable at every angle (Shepperd)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    largest = 0
    best = trace
    for i in range(3):
        if R[i, i] > best:
            best = R[i, i]
            largest = i + 1
    if largest == 0:
        q[0] = 1.0 + trace
        q[1] = R[2, 1] - R[1, 2]
        q[2] = R[0, 2] - R[2, 0]
        q[3] = R[1, 0] - R[0, 1]
    else:
        i = largest - 1
        j = (i + 1) % 3
        k = (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + k] = R[k, i] + R[i, k]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        norm = -norm
    for i in range(4):
        q[i] /= norm
    return q


@kernel
def matrix_from_quat_wxyz(q: Array) -> Array:
    """Rotation matrix of a quaternion (w, x, y, z), normalized first."""
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] / n, q[1] / n, q[2] / n, q[3] / n
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return out


@kernel
def so3_log(R: Array) -> Array:
    """Rotation vector (3,) rad, of angle in [0, pi], stable near 0 and near pi."""
    q = quat_wxyz_from_matrix(R)
    s = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = 2.0 / q[0] if s < 1e-10 else 2.0 * math.atan2(s, q[0]) / s
    return np.array([scale * q[1], scale * q[2], scale * q[3]])


@kernel
def so3_perturbed(R: Array, w: Array) -> Array:
    """R Exp(w), put back onto SO(3): rounding does not add up over the steps of an estimator."""
    return matrix_from_quat_wxyz(quat_wxyz_from_matrix(matmul(R, so3_exp(w))))


@kernel
def skew_squared(v: Array) -> Array:
    """skew(v) @ skew(v) = v v^T - |v|^2 I."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = v[i] * v[j]
    norm2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    for i in range(3):
        out[i, i] -= norm2
    return out


@kernel
def right_jacobian(w: Array) -> Array:
    """J_r (3, 3): Exp(w + d) = Exp(w) Exp(J_r d)."""
    theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    W = skew(w)
    if theta2 < 1e-8:
        near: Array = np.eye(3) - 0.5 * W + skew_squared(w) / 6.0
        return near
    theta = math.sqrt(theta2)
    a = (1.0 - math.cos(theta)) / theta2
    b = (theta - math.sin(theta)) / (theta2 * theta)
    out: Array = np.eye(3) - a * W + b * skew_squared(w)
    return out


@kernel
def right_jacobian_inverse(w: Array) -> Array:
    """J_r^-1 (3, 3): Log(Exp(w) Exp(d)) = w + J_r^-1 d."""
    theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    W = skew(w)
    if theta2 < 1e-8:
        near: Array = np.eye(3) + 0.5 * W + skew_squared(w) / 12.0
        return near
    theta = math.sqrt(theta2)
    # (1 + cos)/sin as cot(theta / 2): finite at pi, where 1 + cos and sin both vanish
    b = 1.0 / theta2 - 0.5 / (theta * math.tan(0.5 * theta))
    out: Array = np.eye(3) + 0.5 * W + b * skew_squared(w)
    return out


@kernel
def rotation_angle(R: Array) -> float:
    """Angle of R in rad, in [0, pi], without the loss of precision of arccos near 0."""
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    return math.atan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
