"""Normalized estimation error squared: whether the covariances say the truth about the errors.

Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 5.4.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from lodelight.trajectory import Trajectory
from lodelight.types import Array

CHI2_95_OF_6 = 2.0 * float(gammaincinv(3.0, 0.95))


@dataclass(frozen=True)
class Nees:
    """NEES divided by its degrees of freedom, so 1 where the covariances are right, more where they are too small.

    within_95 : fraction of poses inside their own 95 % ellipsoid
    """

    poses: int
    pose: float
    rotation: float
    position: float
    within_95: float


def nees(estimate: Trajectory, truth: Trajectory, covariance: Array) -> Nees | None:
    """Mean over the poses whose covariance is positive definite; None where there is none.

    estimate, truth : paths of equal length in one world frame, the one in which the covariances are given
    covariance : (N, 6, 6), rotation (rad, body frame) first, then position (m, world axes)
    """
    finite: Array = np.where(np.isfinite(covariance).all(axis=(1, 2), keepdims=True), covariance, 0.0)
    proper = np.linalg.eigvalsh(finite)[:, 0] > 0.0
    if not proper.any():
        return None
    d, covariance = chart_errors(estimate, truth)[proper], covariance[proper]
    whole = _squared(d, covariance)
    return Nees(
        poses=len(d),
        pose=float(whole.mean()) / 6,
        rotation=float(_squared(d[:, :3], covariance[:, :3, :3]).mean()) / 3,
        position=float(_squared(d[:, 3:], covariance[:, 3:, 3:]).mean()) / 3,
        within_95=float(np.mean(whole <= CHI2_95_OF_6)),
    )


def nees_of(estimate: Trajectory, truth: Trajectory, covariance: Array) -> Array:
    """(N,) of each pose, divided by its six degrees of freedom; NaN where its covariance is not positive definite."""
    finite: Array = np.where(np.isfinite(covariance).all(axis=(1, 2), keepdims=True), covariance, 0.0)
    proper = np.linalg.eigvalsh(finite)[:, 0] > 0.0
    out = np.full(len(covariance), np.nan)
    out[proper] = _squared(chart_errors(estimate, truth)[proper], covariance[proper]) / 6
    return out


def chart_errors(estimate: Trajectory, truth: Trajectory) -> Array:
    """d (N, 6) with truth = estimate.perturbed(d): Log(R_estimate^T R_truth), then p_truth - p_estimate."""
    turned = Rotation.from_quat(estimate.quat_xyzw).inv() * Rotation.from_quat(truth.quat_xyzw)
    return np.hstack([turned.as_rotvec(), truth.xyz - estimate.xyz])


def _squared(d: Array, covariance: Array) -> Array:
    squared: Array = np.einsum("ni,ni->n", d, np.linalg.solve(covariance, d[:, :, None])[:, :, 0])
    return squared
