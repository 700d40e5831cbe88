"""Algebra of matrices of a few rows, for kernels.

No BLAS call: no threads, the same bytes everywhere, and none of the seconds that compiling `@` costs.
"""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.types import Array


@kernel
def matmul(A: Array, B: Array) -> Array:
    """A @ B."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@kernel
def transposed(A: Array) -> Array:
    """A^T as an array of its own, so that `matmul` is compiled for one memory layout only."""
    out = np.empty((A.shape[1], A.shape[0]))
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[j, i] = A[i, j]
    return out


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


@kernel
def inverse3(
    a00: float, a10: float, a11: float, a20: float, a21: float, a22: float
) -> tuple[float, float, float, float, float, float]:
    """Lower half of the inverse of a symmetric 3x3 matrix by its Cholesky factor; all zero if it is not definite.

    By the factor and not by cofactors: those lose all digits where an eigenvalue is 1e-8 of the others, as the
    depth of a point seen under little parallax is.
    """
    none = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if not a00 > 0.0:
        return none
    i0 = 1.0 / math.sqrt(a00)
    l10, l20 = a10 * i0, a20 * i0
    d1 = a11 - l10 * l10
    if not d1 > 0.0:
        return none
    i1 = 1.0 / math.sqrt(d1)
    l21 = (a21 - l20 * l10) * i1
    d2 = a22 - l20 * l20 - l21 * l21
    if not d2 > 0.0:
        return none
    i2 = 1.0 / math.sqrt(d2)
    m10 = -l10 * i0 * i1  # the inverse of the factor, below its diagonal
    m21 = -l21 * i1 * i2
    m20 = -(l20 * i0 + l21 * m10) * i2
    return i0 * i0 + m10 * m10 + m20 * m20, m10 * i1 + m20 * m21, i1 * i1 + m21 * m21, m20 * i2, m21 * i2, i2 * i2
