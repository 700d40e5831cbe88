"""The path of a run, held to keyframes, so that it moves as the map is corrected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lodelight.geometry.se3 import SE3


@dataclass(frozen=True, eq=False)
class PathNode:
    """A localized frame, held to the keyframe that was its reference.

    before : of a frame that became a keyframe, its reference until then, and T_reference_body to that
    """

    t_ns: int
    reference: int
    T_reference_body: SE3
    before: tuple[int, SE3] | None = None


def laid_down(path: Sequence[PathNode], pose: Callable[[int], SE3]) -> list[SE3]:
    """Poses of all frames, by the present poses of keyframes.

    What the adjustment of the next keyframe did to its place beside the last one is shared out over the frames between
    them, by time: so the path has no step there.
    """
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
