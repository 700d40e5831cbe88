"""Absolute trajectory error: how far each pose lies from the true one after alignment.

Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lodelight.evaluation.align import Mode, align
from lodelight.trajectory import Trajectory
from lodelight.types import Array


@dataclass(frozen=True)
class Ate:
    """Distances between positions in m; rotation_deg is the RMSE of the angles between orientations."""

    rmse_m: float
    mean_m: float
    median_m: float
    p95_m: float
    max_m: float
    rotation_deg: float
    scale: float


def pose_errors(estimate: Trajectory, truth: Trajectory) -> tuple[Array, Array]:
    """Distance (N,) m and angle (N,) rad between the rows of two paths in one world frame."""
    distance: Array = np.linalg.norm(estimate.xyz - truth.xyz, axis=1)
    turned = Rotation.from_quat(truth.quat_xyzw).inv() * Rotation.from_quat(estimate.quat_xyzw)
    return distance, np.asarray(turned.magnitude(), dtype=np.float64)


def ate(estimate: Trajectory, truth: Trajectory, mode: Mode = "se3") -> Ate:
    """Of two paths of equal length, row i of one belonging to row i of the other (see `associate.matched`)."""
    alignment = align(estimate, truth, mode)
    distance, angle = pose_errors(alignment.apply(estimate), truth)
    return Ate(
        rmse_m=rms(distance),
        mean_m=float(distance.mean()),
        median_m=float(np.median(distance)),
        p95_m=float(np.percentile(distance, 95)),
        max_m=float(distance.max()),
        rotation_deg=float(np.rad2deg(rms(angle))),
        scale=alignment.scale,
    )


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))
