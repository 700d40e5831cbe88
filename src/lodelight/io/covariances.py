"""How sure each pose of a trajectory is: `covariance.csv`, and the order in which ROS has it.

ROS orders a covariance x, y, z, rx, ry, rz, all along the fixed axes of the header's frame; ours is rotation first, and
the rotation along the body's axes (the chart of SE3.perturbed):

    Exp(dphi) R = R Exp(dtheta)  =>  dphi = R dtheta,   ros = A ours A^T,  A = [[0, I], [R, 0]]
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.io.stamps import ns_from_text
from lodelight.io.text import read_table, write_text
from lodelight.types import Array

AXES = ("rx", "ry", "rz", "px", "py", "pz")
UPPER = np.triu_indices(6)
NAMES = tuple(f"{AXES[i]}_{AXES[j]}" for i, j in zip(*UPPER, strict=True))
HEADER = (
    "# upper triangle of each pose's 6x6 covariance: rotation (rad, body axes) first, then position (m, world axes)\n"
    "# t_ns," + ",".join(NAMES) + "\n"
)


def write_covariances(path: Path, t_ns: list[int], covariances: Iterable[Array]) -> None:
    """Rows of t_ns and the 21 entries of each (6, 6), as exact as a double is."""
    rows = zip(t_ns, covariances, strict=True)
    lines = [f"{t}," + ",".join(repr(float(v)) for v in C[UPPER]) + "\n" for t, C in rows]
    write_text(path, HEADER + "".join(lines))


def read_covariances(path: Path) -> tuple[NDArray[np.int64], Array]:
    """t_ns (N,) and covariances (N, 6, 6); SourceError where a row is not such."""
    table = read_table(path, len(NAMES), ns_from_text)
    if table.bad:
        raise SourceError(f"{path} line {table.bad[0]}: expected t_ns and {len(NAMES)} numbers")
    return table.t_ns, from_upper(table.values[:, : len(NAMES)])


def from_upper(entries: Array) -> Array:
    """(N, 6, 6) covariances by the entries (N, 21) of their UPPER triangles."""
    out = np.zeros((len(entries), 6, 6))
    out[:, UPPER[0], UPPER[1]] = entries
    out[:, UPPER[1], UPPER[0]] = entries
    return out


def covariance_to_ros(R: Array, ours: Array) -> Array:
    """(6, 6) x, y, z, rx, ry, rz along fixed axes, of one in the chart of SE3.perturbed at rotation R."""
    A = np.zeros((6, 6))
    A[:3, 3:], A[3:, :3] = np.eye(3), R
    out: Array = A @ ours @ A.T
    return out


def covariance_from_ros(R: Array, ros: Array) -> Array:
    """The inverse of `covariance_to_ros`."""
    A = np.zeros((6, 6))
    A[:3, 3:], A[3:, :3] = R.T, np.eye(3)
    out: Array = A @ ros @ A.T
    return out
