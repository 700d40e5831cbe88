"""The loops of bundle adjustment: normal equations, Schur complement over the points, step.

    [ U    W ] [dpose ]     [ g_pose  ]        S dpose = -g_pose + W V^-1 g_point,  S = U - W V^-1 W^T
    [ W^T  V ] [dpoint] = - [ g_point ]        dpoint  = -V^-1 (g_point + W^T dpose)

V is one 3x3 block per point, W one 6x3 block per observation. Observations are sorted by point, and within a point by
the keyframe's position in the order of elimination, those of fixed keyframes (position -1) first.
Source: Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6.
"""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.factors.reprojection import CHI2_PX, CHI2_PX_DEPTH, reprojection
from lodelight.estimation.robust import cauchy
from lodelight.geometry.dense import inverse3
from lodelight.geometry.so3 import so3_perturbed
from lodelight.types import Array, Bools, Ints

# Added to the diagonal of every pose: one that nothing measures stays where it is.
UNMEASURED = 1e-9


@kernel
def linearize(
    models: Ints, params: Array, R_body_cam: Array, p_body_cam: Array, lens: Ints, R: Array, p: Array, xyz: Array,
    keyframe: Ints, point: Ints, px: Array, sigma_px: Array, inv_depth: Array, sigma_inv_depth: Array, weight: Array,
    active: Bools, robust: bool, before: Array,
    chi2: Array, U: Array, g_pose: Array, V: Array, g_point: Array, W: Array,
) -> tuple[float, float]:  # fmt: skip
    """Fill chi2 (N,), U (K, 6, 6) upper half, g_pose (K, 6), V (M, 6) lower half, g_point (M, 3), W (N, 3, 6) as W^T.

    lens (N,) : row of models (C,), params (C, 12), R_body_cam (C, 3, 3), p_body_cam (C, 3) that each is seen by
    Returns the cost, and the cost comparable with `before`: over the observations seen there, with those that left
    the view at the cost they had. So a step is neither rewarded for losing points nor stopped by one.
    """
    E, Rk, pk = np.zeros((2, 3)), np.empty((3, 3)), np.empty(3)
    worn, model, lens_params, R_bc, p_bc = -1, 0, params[0], R_body_cam[0], p_body_cam[0]
    U[:] = 0.0
    g_pose[:] = 0.0
    V[:] = 0.0
    g_point[:] = 0.0
    cost = comparable = 0.0
    for i in range(len(keyframe)):
        k, m = keyframe[i], point[i]
        if lens[i] != worn:
            worn = lens[i]
            model, lens_params, R_bc, p_bc = models[worn], params[worn], R_body_cam[worn], p_body_cam[worn]
        for a in range(3):  # a copy costs less than a view, which counts its references
            pk[a] = p[k, a]
            for b in range(3):
                Rk[a, b] = R[k, a, b]
        rows, r, Ju, Jv, Jd = reprojection(
            model, lens_params, Rk, pk, R_bc, p_bc, xyz[m, 0], xyz[m, 1], xyz[m, 2], px[i, 0], px[i, 1],
            sigma_px[i], inv_depth[i], sigma_inv_depth[i], E,
        )  # fmt: skip
        bound = math.inf if not robust else CHI2_PX_DEPTH if inv_depth[i] > 0.0 else CHI2_PX
        chi2[i] = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        value, w = cauchy(chi2[i], bound)
        if rows == 0:
            chi2[i] = math.inf
            if active[i] and before[i] < math.inf:
                comparable += weight[i] * cauchy(before[i], bound)[0]
        if rows == 0 or not active[i]:
            for c in range(3):
                for a in range(6):
                    W[i, c, a] = 0.0
            continue
        cost += weight[i] * value
        if before[i] < math.inf:
            comparable += weight[i] * value
        w *= weight[i]
        # J_pose = [J_theta | -J_X], J_point = J_X: U, V and W are made of the same three products
        for a in range(3):
            tu, tv, td = w * Ju[a], w * Jv[a], w * Jd[a]
            g_pose[k, a] += tu * r[0] + tv * r[1] + td * r[2]
            for b in range(a, 3):
                U[k, a, b] += tu * Ju[b] + tv * Jv[b] + td * Jd[b]
            for c in range(3):
                tx = tu * Ju[3 + c] + tv * Jv[3 + c] + td * Jd[3 + c]
                U[k, a, 3 + c] -= tx
                W[i, c, a] = tx
        at = 0
        for c in range(3):
            xu, xv, xd = w * Ju[3 + c], w * Jv[3 + c], w * Jd[3 + c]
            gx = xu * r[0] + xv * r[1] + xd * r[2]
            g_pose[k, 3 + c] -= gx
            g_point[m, c] += gx
            for b in range(c + 1):
                xx = xu * Ju[3 + b] + xv * Jv[3 + b] + xd * Jd[3 + b]
                U[k, 3 + b, 3 + c] += xx
                V[m, at] += xx
                W[i, c, 3 + b] = -xx
                W[i, b, 3 + c] = -xx
                at += 1
    return cost, comparable


@kernel
def reduce(
    damping: float, keyframe: Ints, point_start: Ints, fixed_point: Bools, position: Ints, slot: Ints,
    U: Array, g_pose: Array, V: Array, g_point: Array, W: Array, V_inverse: Array, S: Array, b: Array,
) -> None:  # fmt: skip
    """Fill V_inverse (M, 6), S (n_blocks, 6, 6) and b (n, 6), with Marquardt's damping of poses and points."""
    S[:] = 0.0
    for k in range(len(position)):
        i = position[k]
        if i < 0:
            continue
        d = slot[i, i]
        for a in range(6):
            b[i, a] = -g_pose[k, a]
            for c in range(a, 6):
                S[d, a, c] = U[k, a, c]
            S[d, a, a] += damping * U[k, a, a] + UNMEASURED
    Y = np.empty((6, 3))
    for m in range(len(point_start) - 1):
        if fixed_point[m]:
            for c in range(6):
                V_inverse[m, c] = 0.0
            continue
        more = 1.0 + damping
        v = inverse3(V[m, 0] * more, V[m, 1], V[m, 2] * more, V[m, 3], V[m, 4], V[m, 5] * more)
        for c in range(6):
            V_inverse[m, c] = v[c]
        for i in range(point_start[m], point_start[m + 1]):
            pi = position[keyframe[i]]
            if pi < 0:
                continue
            for a in range(6):
                w0, w1, w2 = W[i, 0, a], W[i, 1, a], W[i, 2, a]
                y0 = w0 * v[0] + w1 * v[1] + w2 * v[3]
                y1 = w0 * v[1] + w1 * v[2] + w2 * v[4]
                y2 = w0 * v[3] + w1 * v[4] + w2 * v[5]
                Y[a, 0], Y[a, 1], Y[a, 2] = y0, y1, y2
                b[pi, a] += y0 * g_point[m, 0] + y1 * g_point[m, 1] + y2 * g_point[m, 2]
            for j in range(i, point_start[m + 1]):
                pj = position[keyframe[j]]
                s = slot[pi, pj]
                for a in range(6):
                    y0, y1, y2 = Y[a, 0], Y[a, 1], Y[a, 2]
                    for c in range(6):
                        S[s, a, c] -= y0 * W[j, 0, c] + y1 * W[j, 1, c] + y2 * W[j, 2, c]
                if pi == pj and i != j:  # one point twice in one keyframe: the transposed product as well
                    for a in range(6):
                        for c in range(6):
                            S[s, c, a] -= Y[a, 0] * W[j, 0, c] + Y[a, 1] * W[j, 1, c] + Y[a, 2] * W[j, 2, c]


@kernel
def step(
    keyframe: Ints, point_start: Ints, position: Ints, R: Array, p: Array, xyz: Array, V_inverse: Array,
    g_pose: Array, g_point: Array, W: Array, d_pose: Array, R_new: Array, p_new: Array, xyz_new: Array,
) -> float:  # fmt: skip
    """From the step of the poses d_pose (n, 6) to the new state; returns the gain in chi-square that it promises."""
    gain = 0.0
    for k in range(len(position)):
        i = position[k]
        turned = R[k]
        if i >= 0:
            turned = so3_perturbed(R[k], d_pose[i, :3])
            for a in range(6):
                gain -= g_pose[k, a] * d_pose[i, a]
        for a in range(3):
            p_new[k, a] = p[k, a] + (d_pose[i, 3 + a] if i >= 0 else 0.0)
            for b in range(3):
                R_new[k, a, b] = turned[a, b]
    for m in range(len(point_start) - 1):
        x, y, z = -g_point[m, 0], -g_point[m, 1], -g_point[m, 2]
        for i in range(point_start[m], point_start[m + 1]):
            k = position[keyframe[i]]
            if k >= 0:
                for a in range(6):
                    x -= W[i, 0, a] * d_pose[k, a]
                    y -= W[i, 1, a] * d_pose[k, a]
                    z -= W[i, 2, a] * d_pose[k, a]
        v = V_inverse[m]
        dx = v[0] * x + v[1] * y + v[3] * z
        dy = v[1] * x + v[2] * y + v[4] * z
        dz = v[3] * x + v[4] * y + v[5] * z
        gain -= g_point[m, 0] * dx + g_point[m, 1] * dy + g_point[m, 2] * dz
        xyz_new[m, 0], xyz_new[m, 1], xyz_new[m, 2] = xyz[m, 0] + dx, xyz[m, 1] + dy, xyz[m, 2] + dz
    return gain
