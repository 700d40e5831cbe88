"""What a check found, and the limits beyond which it would spoil a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lodelight.types import Array, Ints

Level = Literal["ok", "note", "fault"]


@dataclass(frozen=True)
class Finding:
    """One check. value in `unit`, sigma its standard deviation where it has one; text says it in words."""

    name: str
    level: Level
    text: str
    value: float | None = None
    unit: str = ""
    sigma: float | None = None

    def row(self) -> dict[str, object]:
        """For JSON."""
        return {
            "check": self.name, "level": self.level, "value": self.value, "unit": self.unit, "sigma": self.sigma,
            "text": self.text,
        }  # fmt: skip


def measured(
    name: str, value: float, sigma: float, limit: float, unit: str, good: str, bad: str, times: float = 4.0
) -> Finding:
    """A fault where a value is over its limit and over so many times its sigma; texts have {value} and {sigma}."""
    wrong = abs(value) > limit and abs(value) > times * sigma
    unsure = 3.0 * sigma > 2.0 * limit
    text = (bad if wrong else good).format(value=value, sigma=sigma)
    if not wrong and unsure:
        text = f"this recording does not tell it (within {sigma:.2g} {unit})"
    return Finding(name, "fault" if wrong else "ok", text, value, unit, sigma)


def jackknifed(J: Array, weight: Array, r: Array, block: Ints) -> Array:
    """(n, n) covariance of a weighted least-squares solution by what each block of residuals, left out, does to it.

    Errors are alike for as long as the same walker or the same bad corner of a lens is in view: what comes of a single
    turn of the body goes with it, and is not sure however many frames show it.
    J (N, n), weight (N,), r (N,) : at the solution; block (M,) : of the first M rows, the others are always in
    Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, 11.5; one Newton step for each block.
    """
    H = (J.T * weight) @ J
    names = np.unique(block)
    moved = []
    for name in names:
        out = np.flatnonzero(block == name)
        JW = J[out].T * weight[out]
        moved.append(np.linalg.lstsq(H - JW @ J[out], JW @ r[out], rcond=None)[0])
    d = np.array(moved)
    covariance: Array = (len(names) - 1) / len(names) * d.T @ d
    return covariance
