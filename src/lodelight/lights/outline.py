"""The outline of a striped light: edges left and right of its bright rows, and the circle through them.

Stripes move every top and bottom, and so the centroid and any box (0.9 to 1.5 px at 60 rows); the ends of a bright
row stay where they are. The level of an edge follows the brightness of its row, so that also a luminaire that fades
towards its rim has a round outline: the same part of its face in every row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import spd_inverse
from lodelight.types import Array, Bytes, Ints

SHAPE_SIGMA = 0.05  # how far from round an outline is expected to be, as a part of its radius
LEAST_EDGES = 8
FLOOR_PX = 0.02


@dataclass(frozen=True, eq=False)
class Outline:
    """centre_px (2,) (u, v); covariance (2, 2) px^2; radius_px; edges (N, 2) px; misfit_px : rms of the inner edges."""

    centre_px: Array
    covariance: Array
    radius_px: float
    edges: Array
    misfit_px: float


@kernel
def row_edges(image: Bytes, rows: Ints, levels: Array, left: int, right: int, edges: Array) -> int:
    """Fill edges (2 N, 2) with (x, y) of the first and the last crossing of a row's level in [left, right); how many.

    Sub-pixel by the line between two pixels. Rows that reach their level at either end, or never, give none.
    """
    count = 0
    for i in range(len(rows)):
        y, level = rows[i], levels[i]
        a, b = left, right - 1
        while a < right and image[y, a] < level:
            a += 1
        while b > a and image[y, b] < level:
            b -= 1
        if a <= left or b >= right - 1 or b - a < 2:
            continue
        inner, outer = float(image[y, a]), float(image[y, a - 1])
        edges[count, 0], edges[count, 1] = a - (inner - level) / (inner - outer), y
        inner, outer = float(image[y, b]), float(image[y, b + 1])
        edges[count + 1, 0], edges[count + 1, 1] = b + (inner - level) / (inner - outer), y
        count += 2
    return count


def fit_outline(edges: Array) -> Outline | None:
    """The circle, a little elliptic where the edges say so, through (N, 2) px; None below eight edges or if none fits.

    Minimises Huber's loss of |M (p - c)| - r, M = 1 + [[a, b], [b, -a]], with a and b expected at 0 +- 0.05: a light
    seen obliquely, or by rows that move, is an ellipse; a few edges cannot say so, and leave it a circle.
    """
    if len(edges) < LEAST_EDGES:
        return None
    mid = edges.mean(axis=0)
    d = edges - mid
    A = np.column_stack([2.0 * d, np.ones(len(d))])
    x, *_ = np.linalg.lstsq(A, (d**2).sum(axis=1), rcond=None)
    radius2 = x[2] + x[0] ** 2 + x[1] ** 2
    if not radius2 > 0.0:
        return None
    state = np.array([x[0], x[1], math.sqrt(radius2), 0.0, 0.0])
    covariance, misfit, good = refine_outline(np.ascontiguousarray(d), state)
    if not good or not 0.0 < state[2] < 4.0 * float(np.ptp(edges[:, 0])):
        return None
    covariance = covariance + FLOOR_PX**2 * np.eye(2)
    return Outline(mid + state[:2], covariance, float(state[2]), edges, misfit)


@kernel
def refine_outline(d: Array, state: Array) -> tuple[Array, float, bool]:
    """Gauss-Newton on (cx, cy, r, a, b) in place; covariance of the centre (2, 2), robust misfit px, success."""
    n = len(d)
    J = np.empty(5)
    scale = 1.0
    out = np.eye(2)
    r = np.empty(n)
    for turn in range(12):
        H, g = np.zeros((5, 5)), np.zeros(5)
        total, inside = 0.0, 0.0
        for i in range(n):
            x, y = d[i, 0] - state[0], d[i, 1] - state[1]
            mx, my = (1.0 + state[3]) * x + state[4] * y, state[4] * x + (1.0 - state[3]) * y
            rho = math.sqrt(mx * mx + my * my)
            if rho < 1e-6:
                return out, 0.0, False
            r[i] = rho - state[2]
            ux, uy = mx / rho, my / rho
            J[0], J[1] = -(ux * (1.0 + state[3]) + uy * state[4]), -(ux * state[4] + uy * (1.0 - state[3]))
            J[2], J[3], J[4] = -1.0, ux * x - uy * y, ux * y + uy * x
            w = 1.0 if abs(r[i]) <= 1.5 * scale else 1.5 * scale / abs(r[i])
            total += w * r[i] * r[i]
            inside += w
            for j in range(5):
                g[j] += w * J[j] * r[i]
                for k in range(5):
                    H[j, k] += w * J[j] * J[k]
        scale = max(1.4826 * median_size(r), 0.02)
        variance = max(total / max(inside - 5.0, 1.0), 1e-4)
        shape = variance / SHAPE_SIGMA**2
        for j in (3, 4):
            H[j, j] += shape
            g[j] += shape * state[j]
        inverse, good = spd_inverse(H)
        if not good:
            return out, 0.0, False
        moved = 0.0
        for j in range(5):
            step = 0.0
            for k in range(5):
                step -= inverse[j, k] * g[k]
            state[j] += step
            if j < 3:
                moved += step * step
        for j in range(2):
            for k in range(2):
                out[j, k] = inverse[j, k] * variance
        if moved < 1e-8 and turn > 1:
            break
    return out, math.sqrt(total / inside), True


@kernel
def median_size(r: Array) -> float:
    """Median of |r| to a thousandth of the largest, by halving: sorting would cost seconds of compilation."""
    low, high = 0.0, 0.0
    for value in r:
        high = max(high, abs(value))
    for _ in range(10):
        middle, below = 0.5 * (low + high), 0
        for value in r:
            if abs(value) < middle:
                below += 1
        if 2 * below < len(r):
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
