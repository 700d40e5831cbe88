"""The motion that best lays one path over another.

Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from lodelight.errors import ConfigError, SourceError
from lodelight.trajectory import Trajectory
from lodelight.types import Array

Mode: TypeAlias = Literal["se3", "yaw", "sim3", "none"]

# Orientations count as lightly as a path of one micrometre: nothing beside a path that moves, everything for one
# that stands still or runs straight, whose positions leave the rotation free.
ORIENTATION_WEIGHT_M2 = 1e-12


@dataclass(frozen=True, eq=False)
class Alignment:
    """p_truth = scale * R @ p_estimate + t; R (3, 3), t (3,) m."""

    R: Array
    t: Array
    scale: float = 1.0

    def apply(self, path: Trajectory) -> Trajectory:
        """The path moved into the truth's world frame."""
        xyz = self.scale * path.xyz @ self.R.T + self.t
        quat = (Rotation.from_matrix(self.R) * Rotation.from_quat(path.quat_xyzw)).as_quat()
        return Trajectory(path.t_ns, xyz, quat)

    def inverse(self) -> Alignment:
        return Alignment(self.R.T, -(self.R.T @ self.t) / self.scale, 1.0 / self.scale)


def align(estimate: Trajectory, truth: Trajectory, mode: Mode = "se3") -> Alignment:
    """Least squares over the positions of two paths of equal length, row i of one belonging to row i of the other.

    mode : se3 rotation and translation; yaw rotation about z and translation (both worlds are level); sim3 also the
    scale (monocular); none leaves the estimate where it is
    Raises ConfigError for another mode; SourceError for sim3 of a path that does not move.
    """
    if mode not in get_args(Mode):
        raise ConfigError(f"--align {mode}: choose one of {', '.join(get_args(Mode))}")
    if mode == "none":
        return Alignment(np.eye(3), np.zeros(3))
    centre_estimate, centre_truth = estimate.xyz.mean(axis=0), truth.xyz.mean(axis=0)
    source, target = estimate.xyz - centre_estimate, truth.xyz - centre_truth
    turned = Rotation.from_quat(truth.quat_xyzw) * Rotation.from_quat(estimate.quat_xyzw).inv()
    covariance = target.T @ source / len(source) + ORIENTATION_WEIGHT_M2 * turned.as_matrix().mean(axis=0)
    R = _yaw_part(covariance) if mode == "yaw" else _nearest_rotation(covariance)
    scale = 1.0
    if mode == "sim3":
        variance = float((source**2).sum()) / len(source)
        if variance < ORIENTATION_WEIGHT_M2:
            raise SourceError("the estimate does not move, so it has no scale to find; use --align se3")
        scale = float(np.trace(R.T @ covariance)) / variance
    return Alignment(R, centre_truth - scale * R @ centre_estimate, scale)


def _nearest_rotation(M: Array) -> Array:
    """The rotation R of largest trace(R.T @ M)."""
    U, _, Vt = np.linalg.svd(M)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R: Array = (U * signs) @ Vt
    return R


def _yaw_part(M: Array) -> Array:
    """The rotation about z of largest trace(R.T @ M)."""
    yaw = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    R: Array = Rotation.from_euler("z", yaw).as_matrix()
    return R
