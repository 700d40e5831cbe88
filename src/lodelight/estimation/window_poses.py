"""Poses of the sliding window as rows of arrays: moved to an exposure, and how far they are from where they were."""

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import matmul, transposed
from lodelight.geometry.so3 import so3_exp, so3_log
from lodelight.types import Array


@kernel
def load_pose(x: Array, f: int, motion: Array, tau: float, R: Array, p: Array) -> None:
    """R, p of row f of x, carried on by tau seconds at the angular rate and velocity in motion (F, 6)."""
    for a in range(3):
        p[a] = x[f, 9 + a] + tau * motion[f, 3 + a]
        for b in range(3):
            R[a, b] = x[f, 3 * a + b]
    if tau != 0.0:
        w = np.empty(3)
        for a in range(3):
            w[a] = tau * motion[f, a]
        turned = matmul(R, so3_exp(w))
        for a in range(3):
            for b in range(3):
                R[a, b] = turned[a, b]


@kernel
def turned_back(J: Array, at: int, motion: Array, f: int, tau: float) -> None:
    """Columns of the rotation at the exposure become those of the rotation at the frame's stamp."""
    w = np.empty(3)
    for a in range(3):
        w[a] = tau * motion[f, a]
    turn = so3_exp(w)
    for row in range(J.shape[0]):
        j0, j1, j2 = J[row, at], J[row, at + 1], J[row, at + 2]
        for b in range(3):
            J[row, at + b] = j0 * turn[b, 0] + j1 * turn[b, 1] + j2 * turn[b, 2]


@kernel
def chart_difference(x: Array, lin: Array, out: Array) -> None:
    """out (F, 15) = (theta, p, v, bg, ba) of x (F, 21) from lin; rows of 12, a pose alone, fill out (F, 6)."""
    R, L = np.empty((3, 3)), np.empty((3, 3))
    for f in range(x.shape[0]):
        for a in range(9):
            R[a // 3, a % 3], L[a // 3, a % 3] = x[f, a], lin[f, a]
        w = so3_log(matmul(transposed(L), R))
        for a in range(3):
            out[f, a] = w[a]
        for a in range(9, x.shape[1]):
            out[f, a - 6] = x[f, a] - lin[f, a]
