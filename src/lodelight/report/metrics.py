"""The figures of a run, as `metrics.json` has them: every key always there."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, get_args

import numpy as np

from lodelight.errors import SourceError
from lodelight.evaluation.align import Mode
from lodelight.evaluation.associate import matched
from lodelight.evaluation.ate import ate
from lodelight.messages import Status
from lodelight.trajectory import Trajectory

MAP_STATS: dict[str, Any] = {
    "keyframes": 0,
    "map_points": 0,
    "gate": {"pass": 0, "veto": 0, "abstain": 0},
    "temporary_points": {"created": 0, "left": 0},
    "loops": 0,
    "relocalizations": 0,
}


def with_map_stats(given: dict[str, Any]) -> dict[str, Any]:
    """What was given, and zeros for what was not."""
    filled = {k: {**v, **given.get(k, {})} if isinstance(v, dict) else given.get(k, v) for k, v in MAP_STATS.items()}
    return {**given, **filled}


def spread_ms(values: Sequence[float]) -> dict[str, float | None]:
    """Mean, median, 95th and 99th percentile and maximum; None where there is nothing to measure."""
    if not len(values):
        return dict.fromkeys(("mean", "p50", "p95", "p99", "max"))
    p50, p95, p99 = (float(v) for v in np.percentile(values, (50, 95, 99)))
    return {"mean": float(np.mean(values)), "p50": p50, "p95": p95, "p99": p99, "max": float(np.max(values))}


def state_fractions(statuses: Sequence[str]) -> dict[str, float]:
    """Fraction of the frames in each state."""
    return {state: statuses.count(state) / max(len(statuses), 1) for state in get_args(Status)}


def ate_entry(estimate: Trajectory, truth: Trajectory, mode: Mode) -> dict[str, Any] | None:
    """None where fewer than two poses have a true one, or nothing moved that a scale could be found of."""
    try:
        result = ate(*matched(estimate, truth), mode)
    except SourceError:
        return None
    names = ("rmse_m", "median_m", "p95_m", "rotation_deg")
    return {name: getattr(result, name) for name in names} | {"align": mode}


def peak_rss_mb() -> float | None:
    """The most memory this process has held; None where the system does not say."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return float(kilobytes) / 1024
