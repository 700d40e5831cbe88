"""One path beside the truth: every figure that `lodelight eval` prints."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from lodelight.evaluation.align import Mode, align
from lodelight.evaluation.associate import associate, coverage, matched
from lodelight.evaluation.ate import Ate, ate
from lodelight.evaluation.nees import Nees, nees
from lodelight.evaluation.rpe import Rpe, rpe
from lodelight.trajectory import Trajectory
from lodelight.types import Array


@dataclass(frozen=True)
class Comparison:
    """What is true of an estimate; lengths in m, of the matched true path."""

    align: Mode
    pairs: int
    estimated: int
    coverage: float
    length_m: float
    ate: Ate
    rpe_1s: Rpe
    rpe_1m: Rpe
    nees: Nees | None

    def as_dict(self) -> dict[str, object]:
        return asdict(self)


def compare(
    estimate: Trajectory,
    truth: Trajectory,
    mode: Mode = "se3",
    max_dt_s: float = 0.02,
    covariances: tuple[NDArray[np.int64], Array] | None = None,
) -> Comparison:
    """Match by time, align, measure.

    covariances : stamps (K,) ns and (K, 6, 6), rotation first, in the estimate's world frame; poses without one are
    left out of the NEES
    Raises SourceError where fewer than two poses match, ConfigError for an unknown mode.
    """
    ours, true = matched(estimate, truth, max_dt_s)
    return Comparison(
        align=mode,
        pairs=len(ours),
        estimated=len(estimate),
        coverage=coverage(estimate.t_ns, truth.t_ns, max_dt_s),
        length_m=true.length_m,
        ate=ate(ours, true, mode),
        rpe_1s=rpe(ours, true, 1.0, "s"),
        rpe_1m=rpe(ours, true, 1.0, "m"),
        nees=_nees(ours, true, mode, covariances) if covariances else None,
    )


def _nees(ours: Trajectory, true: Trajectory, mode: Mode, covariances: tuple[NDArray[np.int64], Array]) -> Nees | None:
    # The truth is moved, not the estimate: so the covariances keep the axes they were given in.
    in_our_world = align(ours, true, mode).inverse().apply(true)
    rows, known = associate(ours.t_ns, covariances[0], 0.0)
    return nees(ours.rows(rows), in_our_world.rows(rows), covariances[1][known])
