"""A path: poses at stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodelight.geometry.se3 import SE3
from lodelight.types import AnyArray, Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses `T_world_body` at increasing stamps.

    t_ns : (N,) int64; xyz : (N, 3) m; quat_xyzw : (N, 4) unit
    """

    t_ns: NDArray[np.int64]
    xyz: Array
    quat_xyzw: Array

    @staticmethod
    def from_poses(t_ns: list[int], poses: list[SE3]) -> Trajectory:
        xyz = np.array([T.t for T in poses]).reshape(-1, 3)
        quat = np.array([T.quat_xyzw for T in poses]).reshape(-1, 4)
        return Trajectory(np.array(t_ns, dtype=np.int64), xyz, quat)

    def __len__(self) -> int:
        return len(self.t_ns)

    def pose(self, i: int) -> SE3:
        """T_world_body of row i."""
        return SE3.from_quat_xyzw(self.xyz[i], self.quat_xyzw[i])

    def rows(self, index: AnyArray) -> Trajectory:
        """The poses of some rows: indices in order, or a mask (N,)."""
        return Trajectory(self.t_ns[index], self.xyz[index], self.quat_xyzw[index])

    @property
    def length_m(self) -> float:
        """Length of the path through all poses."""
        return float(np.linalg.norm(np.diff(self.xyz, axis=0), axis=1).sum()) if len(self) > 1 else 0.0
