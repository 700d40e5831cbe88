"""A point of the world seen by camera 0, with or without its depth.

    X_body = R^T (X - p),   X_cam = R_body_cam^T (X_body - p_body_cam)
    r = ((u(X_cam) - u) / sigma_px, (v(X_cam) - v) / sigma_px, (1 / z - inv_depth) / sigma_inv_depth)

The third row is there when the observation carries a depth (RGB-D, stereo), that is when inv_depth > 0. Inverse
depth, because the noise of a disparity is Gaussian in 1/z and not in z. Derivation: docs/derivations-reprojection.md.
"""

import math
from typing import TypeAlias

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.cameras import MIN_DEPTH_M, project_jacobian
from lodelight.types import Array, Bools

# 95 % of a chi-square distribution with 2 and 3 degrees of freedom
CHI2_PX = 5.991
CHI2_PX_DEPTH = 7.815

# What an observation is worth once it is known to have passed this test, as a share of its information. Rejecting the
# tails of k normal numbers costs E[chi2; chi2 < bound] / (k P(chi2 < bound)) = F_{k+2}(bound) / F_k(bound); the mean
# chi-square of those that passed is smaller by the same factor (Huber, "Robust statistics", 1981, 3.2).
TESTED_PX = 0.8423
TESTED_PX_DEPTH = 0.8771

Row: TypeAlias = tuple[float, float, float, float, float, float]
ZERO = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def reprojection(
    model: int, params: Array, R: Array, p: Array, R_body_cam: Array, p_body_cam: Array,
    X: float, Y: float, Z: float, u: float, v: float, sigma_px: float, inv_depth: float, sigma_inv_depth: float,
    E: Array,
) -> tuple[int, tuple[float, float, float], Row, Row, Row]:  # fmt: skip
    """Rows (0 where the camera cannot see the point, else 2 or 3), whitened residual r, Jacobian row by row.

    R, p : T_world_body; X, Y, Z : the point, m world; E (2, 3) scratch
    A row is [dr/dtheta | dr/dX], right perturbation of R; dr/dp = -dr/dX, since only X - p enters.
    Tuples and not arrays, because they stay in registers: half the time.
    """
    dx, dy, dz = X - p[0], Y - p[1], Z - p[2]
    bx = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
    by = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
    bz = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    ex, ey, ez = bx - p_body_cam[0], by - p_body_cam[1], bz - p_body_cam[2]
    x = R_body_cam[0, 0] * ex + R_body_cam[1, 0] * ey + R_body_cam[2, 0] * ez
    y = R_body_cam[0, 1] * ex + R_body_cam[1, 1] * ey + R_body_cam[2, 1] * ez
    z = R_body_cam[0, 2] * ex + R_body_cam[1, 2] * ey + R_body_cam[2, 2] * ez
    u_pred, v_pred, seen = project_jacobian(model, params, x, y, z, E)
    s = 1.0 / sigma_px
    ru, rv = (u_pred - u) * s, (v_pred - v) * s
    # the last is false where a point or a pixel is NaN
    if not seen or (inv_depth > 0.0 and z < MIN_DEPTH_M) or not ru * ru + rv * rv < math.inf:
        return 0, (0.0, 0.0, 0.0), ZERO, ZERO, ZERO
    Ju = _row(s * E[0, 0], s * E[0, 1], s * E[0, 2], R, R_body_cam, bx, by, bz)
    Jv = _row(s * E[1, 0], s * E[1, 1], s * E[1, 2], R, R_body_cam, bx, by, bz)
    if inv_depth > 0.0:
        Jd = _row(0.0, 0.0, -1.0 / (z * z * sigma_inv_depth), R, R_body_cam, bx, by, bz)
        return 3, (ru, rv, (1.0 / z - inv_depth) / sigma_inv_depth), Ju, Jv, Jd
    return 2, (ru, rv, 0.0), Ju, Jv, ZERO


@kernel
def _row(ex: float, ey: float, ez: float, R: Array, R_body_cam: Array, bx: float, by: float, bz: float) -> Row:
    """One row of the Jacobian from e = dr/dX_cam and X_body."""
    # m = dr/dX_body; d X_body / dtheta = [X_body]x gives m x X_body, and d X_body / dX = R^T
    mx = ex * R_body_cam[0, 0] + ey * R_body_cam[0, 1] + ez * R_body_cam[0, 2]
    my = ex * R_body_cam[1, 0] + ey * R_body_cam[1, 1] + ez * R_body_cam[1, 2]
    mz = ex * R_body_cam[2, 0] + ey * R_body_cam[2, 1] + ez * R_body_cam[2, 2]
    return (
        my * bz - mz * by,
        mz * bx - mx * bz,
        mx * by - my * bx,
        R[0, 0] * mx + R[0, 1] * my + R[0, 2] * mz,
        R[1, 0] * mx + R[1, 1] * my + R[1, 2] * mz,
        R[2, 0] * mx + R[2, 1] * my + R[2, 2] * mz,
    )


@kernel
def inliers_of(chi2: Array, inv_depth: Array) -> Bools:
    """Which observations lie inside the 95 % bound of their degrees of freedom; chi2 is inf where not seen."""
    out = np.empty(len(chi2), np.bool_)
    for i in range(len(chi2)):
        out[i] = chi2[i] <= (CHI2_PX_DEPTH if inv_depth[i] > 0.0 else CHI2_PX)
    return out
