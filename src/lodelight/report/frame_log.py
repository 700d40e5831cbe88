"""The estimates of a run as columns: a robot's hour has a hundred thousand, and each would be a dozen objects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lodelight.geometry.se3 import SE3
from lodelight.io.covariances import UPPER, from_upper
from lodelight.messages import Estimate
from lodelight.trajectory import Trajectory
from lodelight.types import AnyArray, Array, Bools

ROOM = 256


class FrameLog:
    """Rows in the order of the frames; status (N,) in words."""

    def __init__(self) -> None:
        self.status: list[str] = []
        self._columns: dict[str, AnyArray] = {}

    def __len__(self) -> int:
        return len(self.status)

    def add(self, estimate: Estimate, track_ms: float, map_ms: float, details: Mapping[str, float]) -> None:
        n, T = len(self.status), estimate.T_world_body
        self.status.append(estimate.status)
        self._put(n, "t_ns", estimate.t_ns)
        self._put(n, "inliers", estimate.inliers)
        self._put(n, "pose", np.concatenate([T.R.ravel(), T.t]))
        self._put(n, "covariance", estimate.covariance[UPPER])
        self._put(n, "localized", estimate.localized)
        self._put(n, "aligned", bool(estimate.details.get("aligned", 1.0)))
        self._put(n, "ms", np.array([track_ms, map_ms]))
        for name, value in details.items():
            self._put(n, f"detail {name}", float(value))

    def _put(self, row: int, name: str, value: AnyArray | float) -> None:
        """What is told of some frames alone is NaN in the others."""
        column = self._columns.get(name)
        if column is None or row >= len(column):
            like = np.asarray(value)
            room = np.full((row + row // 4 + ROOM, *like.shape), np.nan if like.dtype.kind == "f" else 0, like.dtype)
            if column is not None:
                room[: len(column)] = column
            column = self._columns[name] = room
        column[row] = value

    def column(self, name: str) -> AnyArray:
        """(N, ...) t_ns, inliers, localized, aligned, covariance (N, 21) as of `io.covariances.UPPER`, ms (N, 2)."""
        return self._columns[name][: len(self)] if len(self) else np.zeros(0, np.int64)

    def trajectory(self, rows: Bools) -> Trajectory:
        """The poses (N,) of these frames."""
        t_ns: NDArray[np.int64] = self.column("t_ns")[rows]
        poses = self.column("pose")[rows] if len(self) else np.zeros((0, 12))
        return Trajectory.from_poses(t_ns.tolist(), [SE3(p[:9].reshape(3, 3), p[9:]) for p in poses])

    def covariances(self, rows: Bools) -> Array:
        """(M, 6, 6) of these frames."""
        return from_upper(self.column("covariance")[rows] if len(self) else np.zeros((0, len(UPPER[0]))))

    def csv(self) -> str:
        """`frames.csv`."""
        extra = sorted(name.removeprefix("detail ") for name in self._columns if name.startswith("detail "))
        lines = [",".join(["t_ns,status,inliers,track_ms,map_ms", *extra]) + "\n"]
        details = [self._detail(name) for name in extra]
        t_ns, inliers, ms = (self.column(name) for name in ("t_ns", "inliers", "ms"))
        for i, status in enumerate(self.status):
            cells = ["" if np.isnan(column[i]) else f"{column[i]:g}" for column in details]
            head = f"{t_ns[i]},{status},{inliers[i]},{ms[i, 0]:.3f},{ms[i, 1]:.3f}"
            lines.append(",".join([head, *cells]) + "\n")
        return "".join(lines)

    def _detail(self, name: str) -> AnyArray:
        column = self._columns[f"detail {name}"]
        return np.concatenate([column, np.full(max(len(self) - len(column), 0), np.nan)])
