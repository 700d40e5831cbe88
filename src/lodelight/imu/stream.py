"""Inertial samples as they come: in order or not, twice, late, with holes. What was wrong with them is told."""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable

import numpy as np

from lodelight.imu.samples import REACH_NS, ImuSamples
from lodelight.messages import Imu
from lodelight.rig import ImuSpec
from lodelight.types import Array

EventSink = Callable[..., None]  # called as sink(t_ns, kind, **fields)
GAP_PERIODS = 2.5  # a step longer than so many sampling periods has lost samples
BROKEN_NS = 500_000_000  # a hole longer than this is bridged by nothing
TOLD = 3  # of each kind of fault so many are told one by one; all are counted


class ImuStream:
    """A buffer of samples, sorted by their stamps.

    on_event : told of faults as on_event(t_ns, "imu", why=...), the first TOLD of each kind
    faults : how many of each kind there were: "not a number", "twice", "late", "out of order", "gap"
    """

    def __init__(self, spec: ImuSpec, on_event: EventSink | None = None) -> None:
        self.faults: Counter[str] = Counter()
        self._period_ns = 1e9 / spec.rate_hz if spec.rate_hz > 0 else 0.0
        self._emit: EventSink = on_event or (lambda t_ns, kind, **fields: None)
        self._t: list[int] = []
        self._gyro: list[Array] = []
        self._accel: list[Array] = []
        self._done_ns = -(1 << 62)  # what was given out reaches to here

    def __len__(self) -> int:
        return len(self._t)

    @property
    def newest_ns(self) -> int | None:
        return self._t[-1] if self._t else None

    def add(self, sample: Imu) -> None:
        """Put a sample in its place, or leave it out, telling why."""
        t = sample.t_ns
        if not (np.isfinite(sample.gyro).all() and np.isfinite(sample.accel).all()):
            return self._fault(t, "not a number", "a sample is not finite; it is left out")
        if self._t and t > self._t[-1]:
            step = t - self._t[-1]
            if self._period_ns and step > GAP_PERIODS * self._period_ns:
                self._fault(
                    t, "gap", f"no samples for {step / 1e6:.0f} ms, where {self._period_ns / 1e6:.1f} ms are usual"
                )
            at = len(self._t)
        else:
            at = bisect_left(self._t, t)
            if at < len(self._t) and self._t[at] == t:
                return self._fault(t, "twice", "two samples have the same stamp; the first stays")
            if t <= self._done_ns:
                return self._fault(t, "late", f"a sample came {(self._done_ns - t) / 1e6:.0f} ms late; it is left out")
            if self._t:
                self._fault(
                    t, "out of order", f"a sample is {(self._t[-1] - t) / 1e6:.1f} ms out of order; it is put in place"
                )
        self._t.insert(at, t)
        self._gyro.insert(at, np.asarray(sample.gyro, np.float64))
        self._accel.insert(at, np.asarray(sample.accel, np.float64))
        return None

    def reaches(self, t_ns: int) -> bool:
        """Whether there is a sample at t_ns or after it."""
        return bool(self._t) and self._t[-1] >= t_ns

    def between(self, start_ns: int, end_ns: int) -> ImuSamples | str:
        """The samples from one instant to another, both ends interpolated; or why there are none."""
        missing = self._missing(start_ns, end_ns)
        if missing:
            return missing
        low = max(bisect_left(self._t, start_ns) - 1, 0)
        high = min(bisect_left(self._t, end_ns) + 1, len(self._t))
        self._done_ns = max(self._done_ns, end_ns)
        return ImuSamples(
            np.array(self._t[low:high], np.int64), np.array(self._gyro[low:high]), np.array(self._accel[low:high])
        ).between(start_ns, end_ns)

    def forget_before(self, t_ns: int) -> None:
        """Samples before t_ns are needed no more, save the last of them, which what follows is interpolated from."""
        n = bisect_left(self._t, t_ns) - 1
        if n > 0:
            del self._t[:n], self._gyro[:n], self._accel[:n]

    def _missing(self, start_ns: int, end_ns: int) -> str:
        if not self._t:
            return "no IMU sample has come yet"
        away = max(self._t[0] - start_ns, end_ns - self._t[-1])
        if away > REACH_NS:
            side = "begin after" if self._t[0] > start_ns + REACH_NS else "end before"
            clock = "; the stamps are of another clock" if away > 10_000_000_000 else ""
            return f"no IMU for this frame: its samples {side} it, by {away / 1e9:.3g} s{clock}"
        low, high = bisect_left(self._t, start_ns), bisect_left(self._t, end_ns)
        inner = [start_ns, *self._t[low:high], end_ns]
        hole = max(b - a for a, b in itertools.pairwise(inner))
        if hole > BROKEN_NS:
            return f"no IMU for {hole / 1e9:.2f} s before this frame"
        return ""

    def _fault(self, t_ns: int, kind: str, why: str) -> None:
        self.faults[kind] += 1
        if self.faults[kind] <= TOLD:
            self._emit(t_ns, "imu", why=why, fault=kind)
