"""A tree of boxes over quads (bounding volume hierarchy), and single rays through it.

Source: Wald 2007 for the binned surface area heuristic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.types import Array, Ints

LEAF = 4  # quads
BINS = 12
STACK = 64

# Columns of the geometry table: a quad is origin + a u + b v with a, b in [0, 1]
ORIGIN, NORMAL, U_HAT, V_HAT = 0, 3, 6, 9  # u_hat = u / |u|^2, so that a = (x - origin) . u_hat
U_EDGE, V_EDGE = 12, 15
GEOMETRY_COLUMNS = 18


def geometry_table(origin: Array, u: Array, v: Array) -> Array:
    """(n, 18) float64 of rectangles from their corner and edges, (n, 3) m each; u and v must be at right angles."""
    normal = np.cross(v, u)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u_hat = u / (u * u).sum(axis=1, keepdims=True)
    v_hat = v / (v * v).sum(axis=1, keepdims=True)
    return np.ascontiguousarray(np.hstack([origin, normal, u_hat, v_hat, u, v]))


@dataclass(frozen=True, eq=False)
class Tree:
    """boxes : (nodes, 6) lower and upper corner, m; links : (nodes, 3) int32

    links of a leaf: first place in `order`, count, 0; of an inner node: left child, right child, -1.
    """

    boxes: Array
    links: Ints
    order: Ints


def build_tree(geometry: Array) -> Tree:
    """The tree over all rows of a geometry table."""
    n = len(geometry)
    corners = geometry[:, None, ORIGIN : ORIGIN + 3] + np.stack(
        [
            np.zeros((n, 3)),
            geometry[:, U_EDGE : U_EDGE + 3],
            geometry[:, V_EDGE : V_EDGE + 3],
            geometry[:, U_EDGE : U_EDGE + 3] + geometry[:, V_EDGE : V_EDGE + 3],
        ],
        axis=1,
    )
    boxes, links, order = _build(corners.min(axis=1), corners.max(axis=1))
    return Tree(boxes, links, order)


@kernel
def _area(lo: Array, hi: Array) -> float:
    dx, dy, dz = hi[0] - lo[0], hi[1] - lo[1], hi[2] - lo[2]
    out: float = dx * dy + dy * dz + dz * dx
    return out


@kernel
def _build(lo: Array, hi: Array) -> tuple[Array, Ints, Ints]:
    n = lo.shape[0]
    boxes = np.zeros((2 * n + 1, 6))
    links = np.zeros((2 * n + 1, 3), np.int32)
    order = np.arange(n).astype(np.int32)
    work = np.zeros((2 * n + 1, 3), np.int32)  # node, first, count
    work[0, 2] = n
    todo, nodes = 1, 1
    bin_lo, bin_hi = np.zeros((BINS, 3)), np.zeros((BINS, 3))
    bin_n = np.zeros(BINS, np.int64)
    left_cost = np.zeros(BINS)
    while todo > 0:
        todo -= 1
        node, first, count = work[todo, 0], work[todo, 1], work[todo, 2]
        c_lo, c_hi = np.full(3, np.inf), np.full(3, -np.inf)
        for k in range(3):
            boxes[node, k], boxes[node, 3 + k] = np.inf, -np.inf
        for i in range(first, first + count):
            q = order[i]
            for k in range(3):
                boxes[node, k] = min(boxes[node, k], lo[q, k])
                boxes[node, 3 + k] = max(boxes[node, 3 + k], hi[q, k])
                c = 0.5 * (lo[q, k] + hi[q, k])
                c_lo[k], c_hi[k] = min(c_lo[k], c), max(c_hi[k], c)
        axis = 0
        for k in range(1, 3):
            if c_hi[k] - c_lo[k] > c_hi[axis] - c_lo[axis]:
                axis = k
        width = c_hi[axis] - c_lo[axis]
        if count <= LEAF or width <= 0.0:
            links[node, 0], links[node, 1], links[node, 2] = first, count, 0
            continue
        bin_n[:] = 0
        bin_lo[:], bin_hi[:] = np.inf, -np.inf
        for i in range(first, first + count):
            q = order[i]
            b = min(BINS - 1, int((0.5 * (lo[q, axis] + hi[q, axis]) - c_lo[axis]) / width * BINS))
            bin_n[b] += 1
            for k in range(3):
                bin_lo[b, k], bin_hi[b, k] = min(bin_lo[b, k], lo[q, k]), max(bin_hi[b, k], hi[q, k])
        run_lo, run_hi, run_n = np.full(3, np.inf), np.full(3, -np.inf), 0
        for b in range(BINS - 1):
            run_n += bin_n[b]
            for k in range(3):
                run_lo[k], run_hi[k] = min(run_lo[k], bin_lo[b, k]), max(run_hi[k], bin_hi[b, k])
            left_cost[b] = run_n * _area(run_lo, run_hi) if run_n > 0 else 0.0
        run_lo[:], run_hi[:] = np.inf, -np.inf
        run_n, best, best_cost = 0, -1, np.inf
        for b in range(BINS - 1, 0, -1):
            run_n += bin_n[b]
            for k in range(3):
                run_lo[k], run_hi[k] = min(run_lo[k], bin_lo[b, k]), max(run_hi[k], bin_hi[b, k])
            if run_n > 0 and run_n < count:
                cost = left_cost[b - 1] + run_n * _area(run_lo, run_hi)
                if cost < best_cost:
                    best, best_cost = b, cost
        i, j = first, first + count - 1
        while i <= j:
            q = order[i]
            b = min(BINS - 1, int((0.5 * (lo[q, axis] + hi[q, axis]) - c_lo[axis]) / width * BINS))
            if b < best:
                i += 1
            else:
                order[i], order[j] = order[j], order[i]
                j -= 1
        links[node, 0], links[node, 1], links[node, 2] = nodes, nodes + 1, -1
        work[todo, 0], work[todo, 1], work[todo, 2] = nodes, first, i - first
        work[todo + 1, 0], work[todo + 1, 1], work[todo + 1, 2] = nodes + 1, i, first + count - i
        todo += 2
        nodes += 2
    return boxes[:nodes].copy(), links[:nodes].copy(), order


@kernel
def cast_ray(
    boxes: Array, links: Ints, order: Ints, g: Array, stack: Ints, origin: Array, direction: Array, reach: float,
    any_hit: bool,
) -> tuple[float, int]:  # fmt: skip
    """(distance, quad) of the nearest hit within `reach`, or (inf, -1); with `any_hit` of the first one found.

    g : geometry table; stack : (STACK,) to work in
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    # 0 / 0 in the slab test would be no number; a ray turned by 1e-30 is the same ray
    ix, iy, iz = (
        1.0 / (dx if dx != 0.0 else 1e-30),
        1.0 / (dy if dy != 0.0 else 1e-30),
        1.0 / (dz if dz != 0.0 else 1e-30),
    )
    stack[0] = 0
    top, best, best_quad = 1, reach, -1
    while top > 0:
        top -= 1
        node = stack[top]
        t0, t1 = (boxes[node, 0] - ox) * ix, (boxes[node, 3] - ox) * ix
        near, far = min(t0, t1), max(t0, t1)
        t0, t1 = (boxes[node, 1] - oy) * iy, (boxes[node, 4] - oy) * iy
        near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
        t0, t1 = (boxes[node, 2] - oz) * iz, (boxes[node, 5] - oz) * iz
        near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
        if far < 0.0 or near > far + 1e-9 or near > best:
            continue
        if links[node, 2] < 0:
            stack[top], stack[top + 1] = links[node, 0], links[node, 1]
            top += 2
            continue
        for i in range(links[node, 0], links[node, 0] + links[node, 1]):
            q = order[i]
            rx, ry, rz = ox - g[q, 0], oy - g[q, 1], oz - g[q, 2]
            slope = g[q, 3] * dx + g[q, 4] * dy + g[q, 5] * dz
            t = -(g[q, 3] * rx + g[q, 4] * ry + g[q, 5] * rz) / slope
            if not 0.0 < t < best:
                continue
            px, py, pz = rx + t * dx, ry + t * dy, rz + t * dz
            a = g[q, 6] * px + g[q, 7] * py + g[q, 8] * pz
            b = g[q, 9] * px + g[q, 10] * py + g[q, 11] * pz
            if 0.0 <= a <= 1.0 and 0.0 <= b <= 1.0:
                best, best_quad = t, q
                if any_hit:
                    return best, best_quad
    return (best, best_quad) if best_quad >= 0 else (np.inf, -1)
