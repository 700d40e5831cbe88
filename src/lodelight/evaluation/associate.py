"""Which pose of one path belongs to which of another: the nearest in time, each used once."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.trajectory import Trajectory

Stamps: TypeAlias = NDArray[np.int64]
Indices: TypeAlias = NDArray[np.int64]


def associate(estimate: Stamps, truth: Stamps, max_dt_s: float = 0.02) -> tuple[Indices, Indices]:
    """Pairs of rows that are each other's nearest in time and at most max_dt_s apart.

    estimate, truth : (N,), (M,) ns, increasing
    Returns i_estimate, i_truth (K,), increasing; empty where nothing matches.
    """
    if not len(estimate) or not len(truth):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    to_truth, to_estimate = nearest(estimate, truth), nearest(truth, estimate)
    rows = np.arange(len(estimate), dtype=np.int64)
    close = np.abs(truth[to_truth] - estimate) <= round(max_dt_s * 1e9)
    keep = close & (to_estimate[to_truth] == rows)
    return rows[keep], to_truth[keep]


def matched(estimate: Trajectory, truth: Trajectory, max_dt_s: float = 0.02) -> tuple[Trajectory, Trajectory]:
    """The two paths cut down to their common stamps, row by row; SourceError where fewer than two match."""
    i, j = associate(estimate.t_ns, truth.t_ns, max_dt_s)
    if len(i) < 2:
        raise SourceError(
            f"only {len(i)} of {len(estimate)} estimated poses lie within {max_dt_s:g} s of one of {len(truth)} true "
            "ones; check that both files use the same clock, or allow more with --max-dt"
        )
    return estimate.rows(i), truth.rows(j)


def coverage(estimate: Stamps, truth: Stamps, max_dt_s: float = 0.02) -> float:
    """Fraction of the true poses with an estimate no further in time than the estimate's median spacing.

    The spacing stands in for max_dt_s where it is larger, so that a slow estimate is not counted as one with holes.
    """
    if not len(estimate) or not len(truth):
        return 0.0
    spacing_ns = float(np.median(np.diff(estimate))) if len(estimate) > 1 else 0.0
    distance_ns = np.abs(estimate[nearest(truth, estimate)] - truth)
    return float(np.mean(distance_ns <= max(spacing_ns, max_dt_s * 1e9)))


def nearest(stamps: Stamps, among: Stamps) -> Indices:
    """Row of `among` (increasing, not empty) nearest in time to each stamp; the earlier one of a tie."""
    right = np.clip(np.searchsorted(among, stamps), 1, max(len(among) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(among) - 1)
    return np.where(np.abs(among[right] - stamps) < np.abs(stamps - among[left]), right, left).astype(np.int64)
