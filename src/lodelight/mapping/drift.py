"""How far an estimate can have drifted between two keyframes: by the shortest way that ties them together."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from lodelight.mapping.map import Map

MIN_STEP_M = 1e-6  # the sparse graph takes a length of 0 for no edge


def path_between(map: Map, a: int, b: int) -> tuple[float, float]:
    """Length in m and sum of turns in degrees of the shortest way from keyframe a to keyframe b.

    The ways are those of the spanning tree and of the loops closed so far: a place that was seen again ties what came
    after to what came before. Infinite where nothing ties them.
    """
    k = map.keyframes
    child = np.flatnonzero(k.alive & (k.parent >= 0))
    closed = k.alive[map.loops.a] & k.alive[map.loops.b]
    start = np.concatenate([child, map.loops.a[closed]])
    end = np.concatenate([k.parent[child], map.loops.b[closed]])
    step_m = np.maximum(np.linalg.norm(k.p[start] - k.p[end], axis=1), MIN_STEP_M)
    graph = coo_array((step_m, (start, end)), shape=(len(k), len(k))).tocsr()
    length_m, before = dijkstra(graph, directed=False, indices=a, return_predecessors=True)
    way = [b]
    while way[-1] != a:
        if before[way[-1]] < 0:
            return math.inf, math.inf
        way.append(int(before[way[-1]]))
    R = k.R[way]
    cosine = (np.einsum("nij,nij->n", R[1:], R[:-1]) - 1.0) / 2.0  # half the trace of R1^T R2, less a half
    return float(length_m[b]), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)).sum()))
