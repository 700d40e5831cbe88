"""Cholesky for matrices of a few rows: no BLAS call, so no threads and the same bytes everywhere."""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.types import Array


@kernel
def cholesky(A: Array) -> bool:
    """A (n, n) becomes its lower factor (the upper half is left as it was); False if it is not positive definite."""
    n = A.shape[0]
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= A[j, k] * A[j, k]
        if not d > 0.0:
            return False
        root = math.sqrt(d)
        A[j, j] = root
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s / root
    return True


@kernel
def cholesky_solve(L: Array, b: Array) -> None:
    """b (n,) becomes the solution of L L^T x = b."""
    n = L.shape[0]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= L[k, i] * b[k]
        b[i] = s / L[i, i]


@kernel
def spd_inverse(A: Array) -> tuple[Array, bool]:
    """Inverse of a symmetric positive definite matrix, exactly symmetric; False if it is not one."""
    n = A.shape[0]
    L = A.copy()
    out = np.zeros((n, n))
    if not cholesky(L):
        return out, False
    column = np.empty(n)
    for j in range(n):
        column[:] = 0.0
        column[j] = 1.0
        cholesky_solve(L, column)
        for i in range(j, n):
            out[i, j] = column[i]
            out[j, i] = column[i]
    return out, True
