"""Rigid motions. `T_a_b` maps coordinates in b to a: p_a = T_a_b @ p_b, and inner names meet.

Perturbation on the right, rotation first: T <- T Exp(d), d = (dtheta, dp) applied as
R <- R Exp(dtheta), t <- t + dp. The translation is perturbed in the outer frame, as in `docs/architecture.md`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import overload

import numpy as np

from lodelight.geometry.so3 import (
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
    rotation_angle,
    skew,
    so3_exp,
    so3_log,
)
from lodelight.types import Array


@dataclass(frozen=True, eq=False)
class SE3:
    """A rigid motion: R (3, 3) and t (3,) m."""

    R: Array
    t: Array

    @staticmethod
    def identity() -> SE3:
        return SE3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(T: Array) -> SE3:
        """From a 4x4 or 3x4 homogeneous matrix; its rotation is projected onto SO(3)."""
        U, _, Vt = np.linalg.svd(np.asarray(T, dtype=np.float64)[:3, :3])
        U[:, 2] *= np.linalg.det(U @ Vt)
        return SE3(np.ascontiguousarray(U @ Vt), np.array(T, dtype=np.float64)[:3, 3].copy())

    @staticmethod
    def from_quat_xyzw(t: Array, quat_xyzw: Array) -> SE3:
        """From a translation in m and a quaternion (x, y, z, w), normalized here."""
        x, y, z, w = (float(v) for v in quat_xyzw)
        return SE3(matrix_from_quat_wxyz(np.array([w, x, y, z])), np.array(t, dtype=np.float64))

    @staticmethod
    def exp(d: Array) -> SE3:
        """From d = (rotation vector rad, translation m), both (3,): the chart this project perturbs in."""
        d = np.asarray(d, dtype=np.float64)
        return SE3(so3_exp(d[:3]), d[3:].copy())

    def log(self) -> Array:
        """(rotation vector rad, translation m), the inverse of `exp`."""
        return np.concatenate([so3_log(self.R), self.t])

    @property
    def matrix(self) -> Array:
        out = np.eye(4)
        out[:3, :3] = self.R
        out[:3, 3] = self.t
        return out

    @property
    def quat_xyzw(self) -> Array:
        w, x, y, z = quat_wxyz_from_matrix(self.R)
        return np.array([x, y, z, w])

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(rotation_angle(self.R))

    def exceeds(self, m: float, deg: float) -> bool:
        """Whether it moves by more than m, or turns by more than deg."""
        return float(np.linalg.norm(self.t)) > m or math.degrees(self.angle) > deg

    def inverse(self) -> SE3:
        Rt = np.ascontiguousarray(self.R.T)
        return SE3(Rt, -Rt @ self.t)

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...
    @overload
    def __matmul__(self, other: Array) -> Array: ...
    def __matmul__(self, other: SE3 | Array) -> SE3 | Array:
        """Compose with a motion, or map points (3,) or (N, 3)."""
        if isinstance(other, SE3):
            return SE3(self.R @ other.R, self.R @ other.t + self.t)
        moved: Array = other @ self.R.T + self.t
        return moved

    def perturbed(self, d: Array) -> SE3:
        """R Exp(d[:3]), t + d[3:]: one step of an estimator."""
        return SE3(self.R @ so3_exp(np.asarray(d[:3], dtype=np.float64)), self.t + d[3:])

    def interpolate(self, other: SE3, u: float) -> SE3:
        """From self at u = 0 to other at u = 1: slerp and lerp."""
        w = so3_log(np.ascontiguousarray(self.R.T @ other.R))
        return SE3(self.R @ so3_exp(u * w), (1.0 - u) * self.t + u * other.t)


def level(T: SE3, about: Array) -> SE3:
    """The turn about z and the shift nearest to T that take the point `about` (3,) to where T takes it."""
    yaw = math.atan2(T.R[1, 0] - T.R[0, 1], T.R[0, 0] + T.R[1, 1])
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return SE3(R, T @ about - R @ about)


def carried_covariance(T_world_a: SE3, covariance_a: Array, T_world_b: SE3) -> Array:
    """(6, 6) covariance of a pose b that is fixed to a pose a, both in the chart of SE3.perturbed.

    A turn of a turns b as much and moves it on the arm between them: R_b^T R_a dtheta, dp - R_a [t_ab]x dtheta.
    """
    T_a_b = T_world_a.inverse() @ T_world_b
    J = np.eye(6)
    J[:3, :3] = T_a_b.R.T
    J[3:, :3] = -T_world_a.R @ skew(T_a_b.t)
    carried: Array = J @ covariance_a @ J.T
    return carried
