"""Solving the sliding window: landmarks are eliminated, the rest is factored by rows, and a step is taken."""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.window_visual import LEAST_INV_DEPTH
from lodelight.geometry.dense import inverse3
from lodelight.geometry.so3 import so3_perturbed
from lodelight.types import Array, Ints


@kernel
def eliminate_landmarks(
    damping: float, start: Ints, frame: Ints, pose_at: int, extra: int, frames: int,
    V_in: Array, g_landmark: Array, W: Array, V_inverse: Array, S: Array, b: Array,
) -> None:  # fmt: skip
    """S (n, n) -= W V^-1 W^T in its upper half, b (n,) -= W V^-1 g_landmark.

    extra : columns after those of the `frames` poses that any landmark may touch
    """
    column = np.empty(W.shape[2], np.int64)
    Y, Wc, seen = np.empty((W.shape[2], 3)), np.empty((3, W.shape[2])), np.zeros(frames, np.bool_)
    more = 1.0 + damping
    for m in range(len(start) - 1):
        v = inverse3(V_in[m, 0] * more, V_in[m, 1], V_in[m, 2] * more, V_in[m, 3], V_in[m, 4], V_in[m, 5] * more)
        for c in range(6):
            V_inverse[m, c] = v[c]
        seen[:] = False
        for o in range(start[m], start[m + 1]):
            seen[frame[o]] = True
        n = 0
        for f in range(frames):
            if seen[f]:
                for a in range(6):
                    column[n] = 6 * f + a
                    n += 1
        for a in range(extra):
            column[n] = 6 * frames + a
            n += 1
        for a in range(n):
            w0, w1, w2 = W[m, 0, column[a]], W[m, 1, column[a]], W[m, 2, column[a]]
            Wc[0, a], Wc[1, a], Wc[2, a] = w0, w1, w2
            y0 = w0 * v[0] + w1 * v[1] + w2 * v[3]
            y1 = w0 * v[1] + w1 * v[2] + w2 * v[4]
            y2 = w0 * v[3] + w1 * v[4] + w2 * v[5]
            Y[a, 0], Y[a, 1], Y[a, 2] = y0, y1, y2
            b[pose_at + column[a]] -= y0 * g_landmark[m, 0] + y1 * g_landmark[m, 1] + y2 * g_landmark[m, 2]
        for a in range(n):
            y0, y1, y2 = Y[a, 0], Y[a, 1], Y[a, 2]
            row = pose_at + column[a]
            for c in range(a, n):
                S[row, pose_at + column[c]] -= y0 * Wc[0, c] + y1 * Wc[1, c] + y2 * Wc[2, c]


@kernel
def factor_rows(S: Array) -> bool:
    """The upper half of S (n, n) becomes U with S = U^T U; False where it is not positive definite.

    By rows, three at a time subtracted from those below: zeros are skipped and the inner loop runs along memory.
    """
    n = S.shape[0]
    for k in range(0, n, 3):
        end = min(k + 3, n)
        for a in range(k, end):
            for r in range(k, a):
                f = S[r, a]
                if f != 0.0:
                    for j in range(a, n):
                        S[a, j] -= f * S[r, j]
            if not S[a, a] > 0.0:
                return False
            inverse = 1.0 / math.sqrt(S[a, a])
            for j in range(a, n):
                S[a, j] *= inverse
        for i in range(end, n):  # only where there are three
            f0, f1, f2 = S[k, i], S[k + 1, i], S[k + 2, i]
            if f0 != 0.0 or f1 != 0.0 or f2 != 0.0:
                for j in range(i, n):
                    S[i, j] -= f0 * S[k, j] + f1 * S[k + 1, j] + f2 * S[k + 2, j]
    return True


@kernel
def solve_rows(U: Array, b: Array) -> None:
    """b (n,) becomes the solution of U^T U x = b."""
    n = U.shape[0]
    for k in range(n):
        b[k] /= U[k, k]
        f = b[k]
        if f != 0.0:
            for j in range(k + 1, n):
                b[j] -= f * U[k, j]
    for k in range(n - 1, -1, -1):
        s = b[k]
        for j in range(k + 1, n):
            s -= U[k, j] * b[j]
        b[k] = s / U[k, k]


@kernel
def step(
    damping: float, x: Array, mount: Array, offset_s: Array, tag: Array, tag_column: Ints, landmark: Array,
    start: Ints, frame: Ints, pose_at: int, mount_at: int, offset_at: int, extra: int,
    H: Array, g: Array, V_in: Array, g_landmark: Array, W: Array, V_inverse: Array, S: Array,
    x_new: Array, mount_new: Array, offset_new: Array, tag_new: Array, landmark_new: Array,
) -> float:  # fmt: skip
    """Solve the damped normal equations and move; returns the gain in chi-square promised, -1 if not definite."""
    n, F = len(g), x.shape[0]
    b = np.empty(n)
    for i in range(n):
        b[i] = g[i]
        for j in range(i, n):
            S[i, j] = H[i, j]
        S[i, i] *= 1.0 + damping
    eliminate_landmarks(damping, start, frame, pose_at, extra, F, V_in, g_landmark, W, V_inverse, S, b)
    if not factor_rows(S):
        return -1.0
    for i in range(n):
        b[i] = -b[i]
    solve_rows(S, b)
    gain = 0.0
    for i in range(n):
        gain -= g[i] * b[i]
    d = np.empty(3)
    R = np.empty((3, 3))
    for f in range(F):
        _moved_pose(x, f, b, pose_at + 6 * f, R, d, x_new)
        for a in range(9):
            x_new[f, 12 + a] = x[f, 12 + a] + b[9 * f + a]
    for c in range(mount.shape[0]):
        if mount_at >= 0:
            _moved_pose(mount, c, b, mount_at + 6 * c, R, d, mount_new)
        else:
            mount_new[c] = mount[c]
    offset_new[0] = offset_s[0] + (b[offset_at] if offset_at >= 0 else 0.0)
    for t in range(tag.shape[0]):
        if tag_column[t] >= 0:
            _moved_pose(tag, t, b, tag_column[t], R, d, tag_new)
        else:
            tag_new[t] = tag[t]
    for m in range(len(start) - 1):
        y0, y1, y2 = -g_landmark[m, 0], -g_landmark[m, 1], -g_landmark[m, 2]
        for a in range(W.shape[2]):
            f = b[pose_at + a]
            y0 -= W[m, 0, a] * f
            y1 -= W[m, 1, a] * f
            y2 -= W[m, 2, a] * f
        v = V_inverse[m]
        d0 = v[0] * y0 + v[1] * y1 + v[3] * y2
        d1 = v[1] * y0 + v[2] * y1 + v[4] * y2
        d2 = v[3] * y0 + v[4] * y1 + v[5] * y2
        gain -= g_landmark[m, 0] * d0 + g_landmark[m, 1] * d1 + g_landmark[m, 2] * d2
        landmark_new[m, 0] = landmark[m, 0] + d0
        landmark_new[m, 1] = landmark[m, 1] + d1
        landmark_new[m, 2] = max(landmark[m, 2] + d2, LEAST_INV_DEPTH)
    return gain


@kernel
def _moved_pose(x: Array, f: int, b: Array, at: int, R: Array, d: Array, out: Array) -> None:
    for a in range(3):
        d[a] = b[at + a]
        out[f, 9 + a] = x[f, 9 + a] + b[at + 3 + a]
        for c in range(3):
            R[a, c] = x[f, 3 * a + c]
    turned = so3_perturbed(R, d)
    for a in range(3):
        for c in range(3):
            out[f, 3 * a + c] = turned[a, c]


@kernel
def marginal_covariance(U: Array, columns: Ints) -> Array:
    """Block of (U^T U)^-1 at `columns` (q,)."""
    q, n = len(columns), U.shape[0]
    out, b = np.empty((q, q)), np.empty(n)
    for i in range(q):
        b[:] = 0.0
        b[columns[i]] = 1.0
        solve_rows(U, b)
        for j in range(q):
            out[i, j] = b[columns[j]]
    return out
