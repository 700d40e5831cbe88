"""Relative pose error: how far the motion over a stretch of time or path is off, whatever the alignment.

Source: Sturm et al., IROS 2012; E = (T_i^-1 T_j)_truth^-1 (T_i^-1 T_j)_estimate over all pairs i < j.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from lodelight.evaluation.associate import Indices
from lodelight.evaluation.ate import rms
from lodelight.trajectory import Trajectory
from lodelight.types import Array

# A pair counts for a stretch when it is this close to it, relatively; across a gap there is none.
TOLERANCE = 0.1


@dataclass(frozen=True)
class Rpe:
    """RMSE over `pairs` stretches; None where the path has no such stretch."""

    pairs: int
    translation_m: float | None
    rotation_deg: float | None


def rpe(estimate: Trajectory, truth: Trajectory, delta: float, unit: Literal["s", "m"]) -> Rpe:
    """Over all stretches of `delta` seconds, or of `delta` metres along the true path.

    estimate, truth : paths of equal length, row i of one belonging to row i of the other
    """
    i, j = stretches(truth, delta, unit)
    if not len(i):
        return Rpe(0, None, None)
    moved_true, turned_true = _relative(truth, i, j)
    moved, turned = _relative(estimate, i, j)
    translation = turned_true.inv().apply(moved - moved_true)
    angle = (turned_true.inv() * turned).magnitude()
    return Rpe(len(i), rms(np.linalg.norm(translation, axis=1)), float(np.rad2deg(rms(np.asarray(angle)))))


def stretches(truth: Trajectory, delta: float, unit: Literal["s", "m"]) -> tuple[Indices, Indices]:
    """For every row i the row j > i that ends a stretch nearest to `delta`, within TOLERANCE of it."""
    along = travelled_m(truth) if unit == "m" else (truth.t_ns - truth.t_ns[0]) / 1e9
    rows = np.arange(len(along), dtype=np.int64)
    after = np.clip(np.searchsorted(along, along + delta), 1, len(along) - 1)
    before = after - 1
    nearer = np.abs(along[after] - along - delta) < np.abs(along[before] - along - delta)
    ends = np.where(nearer, after, before).astype(np.int64)
    good = (np.abs(along[ends] - along - delta) <= TOLERANCE * delta) & (ends > rows)
    return rows[good], ends[good]


def travelled_m(path: Trajectory) -> Array:
    """Length of the path up to each row, (N,) m."""
    steps = np.linalg.norm(np.diff(path.xyz, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _relative(path: Trajectory, i: Indices, j: Indices) -> tuple[Array, Rotation]:
    """Translation (K, 3) and rotation of T_i^-1 T_j."""
    rotation = Rotation.from_quat(path.quat_xyzw)
    from_i = rotation[i].inv()
    moved: Array = from_i.apply(path.xyz[j] - path.xyz[i])
    return moved, from_i * rotation[j]
