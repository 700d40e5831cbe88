"""Do the lights' stamps and the images' come of one clock? The turns that both saw, laid over one another.

Turns over half a second are compared, not headings: neither a map that drifts nor where it lies in the world matters.
Walking and steering turn a body by far more than the noise of a fix; in uniform motion the two cannot be told apart,
and then nothing is said.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from lodelight.types import Array

KEPT_S = 30.0
TURN_S, TURN_WITHIN_S = 0.5, (0.3, 0.8)  # apart, of two fixes that tell a turn; and what is still taken for that
REACH_S, STEP_S = 0.4, 0.01  # offsets that are tried
FLOOR_RAD = math.radians(0.1)  # of a heading, on either side
FEWEST = 20  # turns
OUTLIER_2 = 9.0  # squared sigmas at which a turn's misfit counts no more
CLEARLY = 9.0  # by which an offset must fit better than none, in squared sigmas
LEAST_S = 0.015  # offsets below it move a fix by less than its own error
NS = 1e-9


@dataclass(frozen=True)
class Offset:
    """How late the lights' stamps are; negative where they are early."""

    late_s: float
    sigma_s: float

    @property
    def why(self) -> str:
        side = "late" if self.late_s > 0.0 else "early"
        return (
            f"the lights' stamps are {1e3 * abs(self.late_s):.0f} +- {1e3 * self.sigma_s:.0f} ms {side} against the "
            f"images': of another clock; set lights.late_s={self.late_s:.3f}"
        )


class ClockCheck:
    """Fed with the body's rotation in the map and by the lights, each with its stamp."""

    def __init__(self) -> None:
        self._axis = -1  # of the body, level at first: its azimuth is the heading
        self._origin_ns = 0
        self._body: deque[tuple[float, float]] = deque()
        self._fixes: deque[tuple[float, float, float]] = deque()

    def tracked(self, t_ns: int, R_map_body: Array) -> None:
        """A localized frame."""
        if self._axis < 0:
            self._axis, self._origin_ns = int(np.argmin(np.abs(R_map_body[2]))), t_ns
        t_s = (t_ns - self._origin_ns) * NS
        self._body.append((t_s, self._heading(R_map_body)))
        _shorten(self._body, t_s)

    def fixed(self, t_ns: int, R_world_body: Array, covariance: Array) -> None:
        """A pose by the lights; covariance as in `Estimate`."""
        if self._axis < 0:
            return
        up = R_world_body[2]
        sigma = math.sqrt(max(float(up @ covariance[:3, :3] @ up), 0.0))
        t_s = (t_ns - self._origin_ns) * NS
        self._fixes.append((t_s, self._heading(R_world_body), sigma))
        _shorten(self._fixes, t_s)

    def offset(self) -> Offset | None:
        """The offset of the two clocks, where there clearly is one."""
        if len(self._body) < FEWEST or len(self._fixes) < FEWEST:
            return None
        body, fixes = np.array(self._body), np.array(self._fixes)
        t, heading, sigma = fixes[np.argsort(fixes[:, 0])].T
        before = np.searchsorted(t, t - TURN_S)
        apart = t - t[before]
        inside = (t[before] > body[0, 0] + REACH_S) & (t < body[-1, 0] - REACH_S)
        rows = np.flatnonzero(inside & (apart > TURN_WITHIN_S[0]) & (apart < TURN_WITHIN_S[1]))
        if len(rows) < FEWEST:
            return None
        first = before[rows]
        turned = heading[rows] - heading[first]
        variance = sigma[rows] ** 2 + sigma[first] ** 2 + 2.0 * FLOOR_RAD**2
        of_body = np.unwrap(body[:, 1])
        tried = np.arange(-REACH_S, REACH_S + 0.5 * STEP_S, STEP_S)
        cost = np.empty(len(tried))
        for i, late_s in enumerate(tried):
            expected = np.interp(t[rows] - late_s, body[:, 0], of_body) - np.interp(
                t[first] - late_s, body[:, 0], of_body
            )
            misfit = (turned - expected + math.pi) % (2.0 * math.pi) - math.pi
            cost[i] = np.minimum(misfit**2 / variance, OUTLIER_2).sum()
        overlap = max(1.0, len(rows) * TURN_S / (t[rows[-1]] - t[first[0]]))  # each fix is in so many turns
        return _least(tried, cost / overlap, len(rows) / overlap)

    def _heading(self, R: Array) -> float:
        return math.atan2(R[1, self._axis], R[0, self._axis])


def _least(tried: Array, cost: Array, count: float) -> Offset | None:
    """By a parabola through the least cost and its neighbours; None where none does as well, or the end does best."""
    best = int(np.argmin(cost))
    if best in (0, len(tried) - 1):
        return None
    scale = max(1.0, float(cost[best]) / count)
    left, here, right = cost[best - 1 : best + 2]
    bend = max(float(left - 2.0 * here + right), 1e-9)
    late_s = float(tried[best] + 0.5 * STEP_S * (left - right) / bend)
    none = float(np.interp(0.0, tried, cost))
    if abs(late_s) < LEAST_S or none - here < CLEARLY * scale:
        return None
    return Offset(late_s, STEP_S * math.sqrt(2.0 * scale / bend))


def _shorten(rows: deque, t_s: float) -> None:  # type: ignore[type-arg]
    while rows and t_s - rows[0][0] > KEPT_S:
        rows.popleft()
