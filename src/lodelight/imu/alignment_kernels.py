"""The loops of the alignment: normal equations with landmarks eliminated, and the landmarks again."""

from __future__ import annotations

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import inverse3, matmul, transposed
from lodelight.types import Array, Ints

N = 11  # gravity's direction 2, velocity 3, gyro bias 3, accelerometer bias 3
HUBER = 1.5  # of a ray's angle, in units of its noise


@kernel
def _ray_row(
    R: Array, p: Array, R_cam: Array, p_cam: Array, ray: Array, inv_depth: float, along: float, distance: float,
    P: Array, centre: Array, u: Array,
) -> None:  # fmt: skip
    """P (3, 3), the weight of X - centre; centre (3,) of the camera but for what is unknown; u (3,) = P centre + ..."""
    f = np.empty(3)
    g = np.empty(3)
    for i in range(3):
        g[i] = R_cam[i, 0] * ray[0] + R_cam[i, 1] * ray[1] + R_cam[i, 2] * ray[2]
    for i in range(3):
        f[i] = R[i, 0] * g[0] + R[i, 1] * g[1] + R[i, 2] * g[2]
        centre[i] = p[i] + R[i, 0] * p_cam[0] + R[i, 1] * p_cam[1] + R[i, 2] * p_cam[2]
    w = 1.0 / (distance * distance)
    for i in range(3):
        for j in range(3):
            P[i, j] = (along - w) * f[i] * f[j]
        P[i, i] += w
    away = 1.0 / (inv_depth * ray[2]) if along > 0.0 else 0.0
    for i in range(3):
        u[i] = P[i, 0] * centre[0] + P[i, 1] * centre[1] + P[i, 2] * centre[2] + along * away * f[i]


@kernel
def _unknown_part(t: float, jacobian: Array, C: Array) -> None:
    """C (3, 9): the camera's centre by gravity, velocity and accelerometer bias."""
    C[:] = 0.0
    for i in range(3):
        C[i, i], C[i, 3 + i] = 0.5 * t * t, t
        for j in range(3):
            C[i, 6 + j] = jacobian[3 + i, 3 + j]


@kernel
def linear_equations(
    t_s: Array, R: Array, p: Array, jacobian: Array, R_cam: Array, p_cam: Array, frame: Ints, camera: Ints, ray: Array,
    inv_depth: Array, along: Array, start: Ints, distance: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """H (9, 9), b (9,) of x = (gravity, velocity, accelerometer bias), all landmarks eliminated."""
    H, b = np.zeros((9, 9)), np.zeros(9)
    P, C, centre, u = np.empty((3, 3)), np.empty((3, 9)), np.empty(3), np.empty(3)
    Y, A, s = np.empty((3, 9)), np.empty((3, 3)), np.empty(3)
    for m in range(len(start) - 1):
        if start[m + 1] - start[m] < 2:
            continue
        Y[:], A[:], s[:] = 0.0, 0.0, 0.0
        H_own, b_own = np.zeros((9, 9)), np.zeros(9)
        for row in range(start[m], start[m + 1]):
            k, c = frame[row], camera[row]
            _ray_row(R[k], p[k], R_cam[c], p_cam[c], ray[row], inv_depth[row], along[row], distance[row], P, centre, u)
            _unknown_part(t_s[k], jacobian[k], C)
            PC = matmul(P, C)
            CT = transposed(C)
            H_own += matmul(CT, PC)
            Y += PC
            A += P
            for i in range(9):
                b_own[i] -= C[0, i] * u[0] + C[1, i] * u[1] + C[2, i] * u[2]
            s += u
        V = _inverse(A)
        if V[2, 2] == 0.0:
            continue
        VY = matmul(V, Y)
        H += H_own - matmul(transposed(Y), VY)
        for i in range(9):
            b[i] += b_own[i] + VY[0, i] * s[0] + VY[1, i] * s[1] + VY[2, i] * s[2]
    return H, b


@kernel
def _inverse(A: Array) -> Array:
    v00, v10, v11, v20, v21, v22 = inverse3(A[0, 0], A[1, 0], A[1, 1], A[2, 0], A[2, 1], A[2, 2])
    V = np.empty((3, 3))
    V[0, 0], V[1, 1], V[2, 2] = v00, v11, v22
    V[0, 1] = V[1, 0] = v10
    V[0, 2] = V[2, 0] = v20
    V[1, 2] = V[2, 1] = v21
    return V


@kernel
def linear_landmarks(
    t_s: Array, R: Array, p: Array, jacobian: Array, R_cam: Array, p_cam: Array, frame: Ints, camera: Ints, ray: Array,
    inv_depth: Array, along: Array, start: Ints, x: Array, distance: Array, X: Array,
) -> float:  # fmt: skip
    """Fill X (M, 3), NaN where it is not ahead of its cameras, and distance (N,); returns the share behind."""
    P, C, centre, u = np.empty((3, 3)), np.empty((3, 9)), np.empty(3), np.empty(3)
    A, s, off = np.empty((3, 3)), np.empty(3), np.empty(3)
    n_behind, n_all = 0, 0
    for m in range(len(start) - 1):
        A[:], s[:] = 0.0, 0.0
        X[m] = math.nan
        if start[m + 1] - start[m] < 2:
            continue
        for row in range(start[m], start[m + 1]):
            k, c = frame[row], camera[row]
            _ray_row(R[k], p[k], R_cam[c], p_cam[c], ray[row], inv_depth[row], along[row], distance[row], P, centre, u)
            _unknown_part(t_s[k], jacobian[k], C)
            for i in range(3):
                off[i] = 0.0
                for j in range(9):
                    off[i] += C[i, j] * x[j]
            for i in range(3):
                s[i] += u[i] + P[i, 0] * off[0] + P[i, 1] * off[1] + P[i, 2] * off[2]
            A += P
        V = _inverse(A)
        if V[2, 2] == 0.0:
            continue
        for i in range(3):
            X[m, i] = V[i, 0] * s[0] + V[i, 1] * s[1] + V[i, 2] * s[2]
        behind = 0
        for row in range(start[m], start[m + 1]):
            k, c = frame[row], camera[row]
            _ray_row(R[k], p[k], R_cam[c], p_cam[c], ray[row], inv_depth[row], along[row], distance[row], P, centre, u)
            _unknown_part(t_s[k], jacobian[k], C)
            ahead, d2 = 0.0, 0.0
            for i in range(3):
                d = X[m, i] - centre[i]
                for j in range(9):
                    d -= C[i, j] * x[j]
                f = 0.0
                for j in range(3):
                    g = R_cam[c, j, 0] * ray[row, 0] + R_cam[c, j, 1] * ray[row, 1] + R_cam[c, j, 2] * ray[row, 2]
                    f += R[k, i, j] * g
                ahead += f * d
                d2 += d * d
            distance[row] = min(max(math.sqrt(d2), 0.2), 100.0)
            behind += ahead <= 0.0
        n_all += 1
        if 2 * behind > start[m + 1] - start[m]:
            n_behind += 1
            X[m] = math.nan
    return n_behind / max(n_all, 1)


@kernel
def angle_equations(
    t_s: Array, R: Array, p: Array, jacobian: Array, R_cam: Array, p_cam: Array, frame: Ints, camera: Ints, ray: Array,
    inv_depth: Array, sigma_inv_depth: Array, start: Ints, X: Array, g_tangent: Array, sigma: float, damping: float,
    H: Array, b: Array, V_inverse: Array, gradient: Array, W: Array,
) -> tuple[float, int, int, float]:  # fmt: skip
    """Fill H (11, 11), b (11,), with the landmarks eliminated, and V_inverse, gradient, W of every landmark.

    Returns the robust cost, rays within the kernel's bound, rays used, and the squared errors of those within.
    """
    cost, inliers, used, total = 0.0, 0, 0, 0.0
    J, Jx, e = np.empty((3, 11)), np.empty((3, 3)), np.empty(3)
    y, B, Jy, A = np.empty(3), np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    Jp, Jt = np.empty((3, 3)), np.empty((3, 3))
    for m in range(len(start) - 1):
        if X[m, 0] != X[m, 0] or start[m + 1] - start[m] < 2:
            continue
        V = np.zeros((3, 3))
        for row in range(start[m], start[m + 1]):
            k, c, t = frame[row], camera[row], t_s[frame[row]]
            body = np.empty(3)
            for i in range(3):
                body[i] = 0.0
                for j in range(3):
                    body[i] += R[k, j, i] * (X[m, j] - p[k, j])
            for i in range(3):
                y[i] = 0.0
                for j in range(3):
                    y[i] += R_cam[c, j, i] * (body[j] - p_cam[c, j])
            length = math.sqrt(y[0] ** 2 + y[1] ** 2 + y[2] ** 2)
            f = ray[row]
            if y[0] * f[0] + y[1] * f[1] + y[2] * f[2] <= 0.1 * length or length < 1e-6:
                cost += 100.0
                continue
            _across(f, B)
            n = 2
            for a in range(2):
                e[a] = 0.0
                for i in range(3):
                    e[a] += B[a, i] * y[i] / length
                e[a] /= sigma
            for a in range(2):
                for j in range(3):
                    Jy[a, j] = (B[a, j] - e[a] * sigma * y[j] / length) / (length * sigma)
            if inv_depth[row] > 0.0 and y[2] > 1e-3:
                n = 3
                e[2] = (1.0 / y[2] - inv_depth[row]) / sigma_inv_depth[row]
                Jy[2, 0] = Jy[2, 1] = 0.0
                Jy[2, 2] = -1.0 / (y[2] * y[2] * sigma_inv_depth[row])
            for i in range(3):  # A = R_cam^T R_k^T
                for j in range(3):
                    A[i, j] = 0.0
                    for q in range(3):
                        A[i, j] += R_cam[c, q, i] * R[k, j, q]
            for a in range(n):
                for j in range(3):
                    Jx[a, j] = Jy[a, 0] * A[0, j] + Jy[a, 1] * A[1, j] + Jy[a, 2] * A[2, j]
                    Jp[a, j] = 0.0  # of the body frame's axes
                    for q in range(3):
                        Jp[a, j] += Jy[a, q] * R_cam[c, j, q]
                # y moves by R_cam^T [body]x dtheta
                Jt[a, 0] = Jp[a, 1] * body[2] - Jp[a, 2] * body[1]
                Jt[a, 1] = Jp[a, 2] * body[0] - Jp[a, 0] * body[2]
                Jt[a, 2] = Jp[a, 0] * body[1] - Jp[a, 1] * body[0]
                for i in range(2):
                    J[a, i] = 0.0
                    for j in range(3):
                        J[a, i] -= Jx[a, j] * 0.5 * t * t * g_tangent[j, i]
                for i in range(3):
                    J[a, 2 + i] = -t * Jx[a, i]
                for i in range(6):
                    J[a, 5 + i] = 0.0
                    for j in range(3):
                        J[a, 5 + i] += -Jx[a, j] * jacobian[k, 3 + j, i] + Jt[a, j] * jacobian[k, j, i]
            norm2 = 0.0
            for a in range(n):
                norm2 += e[a] * e[a]
            norm, w = math.sqrt(norm2), 1.0
            used += 1
            if norm > HUBER:
                w = HUBER / norm
                cost += HUBER * (2.0 * norm - HUBER)
            else:
                cost += norm2
            if norm < 3.0:
                inliers += 1
                total += norm2
            for a in range(n):
                for i in range(11):
                    b[i] -= w * J[a, i] * e[a]
                    for j in range(i + 1):
                        H[i, j] += w * J[a, i] * J[a, j]
                    for j in range(3):
                        W[m, i, j] += w * J[a, i] * Jx[a, j]
                for i in range(3):
                    gradient[m, i] -= w * Jx[a, i] * e[a]
                    for j in range(3):
                        V[i, j] += w * Jx[a, i] * Jx[a, j]
        for i in range(3):
            V[i, i] += damping * V[i, i] + 1e-9
        v = inverse3(V[0, 0], V[1, 0], V[1, 1], V[2, 0], V[2, 1], V[2, 2])
        for i in range(6):
            V_inverse[m, i] = v[i]
        WV = np.empty((11, 3))
        for i in range(11):
            WV[i, 0] = W[m, i, 0] * v[0] + W[m, i, 1] * v[1] + W[m, i, 2] * v[3]
            WV[i, 1] = W[m, i, 0] * v[1] + W[m, i, 1] * v[2] + W[m, i, 2] * v[4]
            WV[i, 2] = W[m, i, 0] * v[3] + W[m, i, 1] * v[4] + W[m, i, 2] * v[5]
        for i in range(11):
            for q in range(3):
                b[i] -= WV[i, q] * gradient[m, q]
            for j in range(i + 1):
                for q in range(3):
                    H[i, j] -= WV[i, q] * W[m, j, q]
    for i in range(11):
        H[i, i] *= 1.0 + damping
        for j in range(i):
            H[j, i] = H[i, j]
    return cost, inliers, used, total


@kernel
def step_landmarks(X: Array, V_inverse: Array, gradient: Array, W: Array, d: Array) -> None:
    """Move X (M, 3) by what is left of each landmark's equations after the step d (11,)."""
    r = np.empty(3)
    for m in range(len(X)):
        if X[m, 0] != X[m, 0]:
            continue
        for i in range(3):
            r[i] = gradient[m, i]
            for j in range(len(d)):
                r[i] -= W[m, j, i] * d[j]
        v = V_inverse[m]
        X[m, 0] += v[0] * r[0] + v[1] * r[1] + v[3] * r[2]
        X[m, 1] += v[1] * r[0] + v[2] * r[1] + v[4] * r[2]
        X[m, 2] += v[3] * r[0] + v[4] * r[1] + v[5] * r[2]


@kernel
def _across(f: Array, B: Array) -> None:
    """B (2, 3): two unit vectors across a unit ray and each other."""
    least = 0
    for i in range(1, 3):
        if abs(f[i]) < abs(f[least]):
            least = i
    a = np.zeros(3)
    a[least] = 1.0
    x, y, z = f[1] * a[2] - f[2] * a[1], f[2] * a[0] - f[0] * a[2], f[0] * a[1] - f[1] * a[0]
    n = math.sqrt(x * x + y * y + z * z)
    B[0, 0], B[0, 1], B[0, 2] = x / n, y / n, z / n
    B[1, 0] = f[1] * B[0, 2] - f[2] * B[0, 1]
    B[1, 1] = f[2] * B[0, 0] - f[0] * B[0, 2]
    B[1, 2] = f[0] * B[0, 1] - f[1] * B[0, 0]
