"""The path of a run, held to keyframes, so that it moves as the map is corrected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.mapping.table import Table
from lodelight.types import AnyArray


@dataclass(frozen=True, eq=False)
class PathNode:
    """A localized frame, held to the keyframe that was its reference.

    before : of a frame that became a keyframe, its reference until then, and T_reference_body to that
    """

    t_ns: int
    reference: int
    T_reference_body: SE3
    before: tuple[int, SE3] | None = None


class Path(Sequence[PathNode]):
    """Nodes as rows of a table: an hour has a hundred thousand, and as objects they take three times the memory."""

    def __init__(self) -> None:
        pose, i32 = (np.float64, (4, 3)), (np.int32, ())
        self._rows = Table(t_ns=(np.int64, ()), reference=i32, T=pose, before=i32, T_before=pose)

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, node: PathNode) -> None:
        self._rows.append(1)
        self[-1] = node

    def __setitem__(self, at: int, node: PathNode) -> None:
        row = self._rows
        row.t_ns[at], row.reference[at], row.T[at] = node.t_ns, node.reference, _packed(node.T_reference_body)
        row.before[at] = -1
        if node.before is not None:
            row.before[at], row.T_before[at] = node.before[0], _packed(node.before[1])

    def __getitem__(self, at: int) -> PathNode:  # type: ignore[override]
        row = self._rows
        before = int(row.before[at])
        return PathNode(
            int(row.t_ns[at]), int(row.reference[at]), _unpacked(row.T[at]),
            (before, _unpacked(row.T_before[at])) if before >= 0 else None,
        )  # fmt: skip


def _packed(T: SE3) -> AnyArray:
    return np.vstack([T.R, T.t])


def _unpacked(rows: AnyArray) -> SE3:
    return SE3(rows[:3].copy(), rows[3].copy())


def laid_down(path: Sequence[PathNode], pose: Callable[[int], SE3]) -> list[SE3]:
    """Poses of all frames, by the present poses of keyframes.

    What the adjustment of the next keyframe did to its place beside the last one is shared out over the frames between
    them, by time: so the path has no step there.
    """
    path = list(path)  # its nodes are made when they are asked for
    out = [pose(node.reference) @ node.T_reference_body for node in path]
    begin = 0
    for end, node in enumerate(path):
        if node.before is not None:
            reference, T_reference_body = node.before
            moved = ((pose(reference) @ T_reference_body).inverse() @ out[end]).log()
            t0, t1 = path[begin].t_ns, node.t_ns
            for i in range(begin, end):
                if path[i].reference == reference:
                    out[i] = out[i] @ SE3.exp((path[i].t_ns - t0) / (t1 - t0) * moved)
        if node.reference != path[begin].reference:
            begin = end
    return out
