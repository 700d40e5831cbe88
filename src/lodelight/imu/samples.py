"""A stretch of inertial samples, and the part of it between two instants."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.messages import Imu
from lodelight.types import Array

NS_PER_S = 1_000_000_000
# How far beyond its last sample a stream may be held constant: two samples of the slowest sensors in use (25 Hz). More
# is a loss of data, which whoever holds the stream must notice.
REACH_NS = 80_000_000


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """t_ns (N,) rising; gyro (N, 3) rad/s and accel (N, 3) m/s^2 (specific force), body frame."""

    t_ns: NDArray[np.int64]
    gyro: Array
    accel: Array

    @staticmethod
    def of(messages: Iterable[Imu]) -> ImuSamples:
        kept = list(messages)
        return ImuSamples(
            np.array([m.t_ns for m in kept], dtype=np.int64),
            np.array([m.gyro for m in kept], dtype=np.float64).reshape(-1, 3),
            np.array([m.accel for m in kept], dtype=np.float64).reshape(-1, 3),
        )

    def __len__(self) -> int:
        return len(self.t_ns)

    def between(self, start_ns: int, end_ns: int) -> ImuSamples:
        """The samples from start to end with both ends interpolated to exactly these stamps.

        Where the stream begins late or ends early its outermost sample is held, for REACH_NS at most.
        Raises SourceError where it does not reach, where stamps do not rise, and where the stretch has no length.
        """
        t = self.t_ns
        if end_ns <= start_ns:
            raise SourceError(f"no time passes between the frames at {start_ns} and {end_ns} ns")
        if len(t) == 0 or t[0] > start_ns + REACH_NS or t[-1] < end_ns - REACH_NS:
            has = f"has {t[0]} to {t[-1]} ns" if len(t) else "is empty"
            raise SourceError(f"the IMU stream {has} and must cover the frames at {start_ns} and {end_ns} ns")
        if not np.all(np.diff(t) > 0):
            raise SourceError("stamps of IMU samples must rise; sort them and drop the repeated ones")
        inner = slice(int(np.searchsorted(t, start_ns, "right")), int(np.searchsorted(t, end_ns, "left")))
        ends = np.array([start_ns, end_ns], dtype=np.int64)
        gyro, accel = (
            np.column_stack([np.interp((ends - t[0]) * 1e-9, (t - t[0]) * 1e-9, values[:, a]) for a in range(3)])
            for values in (self.gyro, self.accel)
        )
        return ImuSamples(
            np.concatenate([ends[:1], t[inner], ends[1:]]),
            np.vstack([gyro[:1], self.gyro[inner], gyro[1:]]),
            np.vstack([accel[:1], self.accel[inner], accel[1:]]),
        )

    def joined(self, later: ImuSamples) -> ImuSamples:
        """With `later` after it, which starts at this one's last stamp. Raises SourceError where it does not."""
        if len(self) == 0:
            return later
        if len(later) == 0 or later.t_ns[0] != self.t_ns[-1]:
            raise SourceError(f"IMU samples to be joined must go on at {self.t_ns[-1]} ns")
        return ImuSamples(
            np.concatenate([self.t_ns, later.t_ns[1:]]),
            np.vstack([self.gyro, later.gyro[1:]]),
            np.vstack([self.accel, later.accel[1:]]),
        )
