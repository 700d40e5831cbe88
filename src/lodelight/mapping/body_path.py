"""Where the body was lately, held to keyframes, so that it moves with the map."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map

NS = 1e-9
KEPT = 256  # frames
GAP_S = 0.25  # between two frames that are interpolated


@dataclass(frozen=True, eq=False)
class Node:
    """T_reference_body at a time, in a keyframe's own frame."""

    t_ns: int
    reference: int
    T_reference_body: SE3


class BodyPath:
    """The last localized frames of a map."""

    def __init__(self, map: Map) -> None:
        self._map = map
        self._nodes: deque[Node] = deque(maxlen=KEPT)

    def add(self, node: Node) -> None:
        """A localized frame, by rising stamp."""
        self._nodes.append(node)

    @property
    def last_ns(self) -> int | None:
        """Of the last localized frame."""
        return self._nodes[-1].t_ns if self._nodes else None

    def pose(self, node: Node) -> SE3:
        """T_map_body, as the map stands now."""
        return self._map.pose(node.reference) @ node.T_reference_body

    def at(self, t_ns: int) -> Node | None:
        """Between two localized frames; None where none enclose that time, or they lie far apart."""
        nodes = self._nodes
        for i in range(len(nodes) - 1, -1, -1):
            if nodes[i].t_ns == t_ns:
                return nodes[i]
            if nodes[i].t_ns < t_ns:
                if i + 1 == len(nodes) or (nodes[i + 1].t_ns - nodes[i].t_ns) * NS > GAP_S:
                    return None
                a, b = nodes[i], nodes[i + 1]
                T = self.pose(a).interpolate(self.pose(b), (t_ns - a.t_ns) / (b.t_ns - a.t_ns))
                return Node(t_ns, b.reference, self._map.pose(b.reference).inverse() @ T)
        return None
