"""A point of the world seen by camera 0, with or without its depth.

    X_body = R^T (X - p),   X_cam = R_body_cam^T (X_body - p_body_cam)
    r = ((u(X_cam) - u) / sigma_px, (v(X_cam) - v) / sigma_px, (1 / z - inv_depth) / sigma_inv_depth)

The third row is there when the observation carries a depth (RGB-D, stereo), that is when inv_depth > 0. Inverse
depth, because the noise of a disparity is Gaussian in 1/z and not in z. Derivation: docs/derivations-reprojection.md.
"""

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.cameras import MIN_DEPTH_M, project_jacobian
from lodelight.types import Array, Bools

# 95 % of a chi-square distribution with 2 and 3 degrees of freedom
CHI2_PX = 5.991
CHI2_PX_DEPTH = 7.815


@kernel
def reprojection(
    model: int, params: Array, R: Array, p: Array, R_body_cam: Array, p_body_cam: Array, X: Array,
    u: float, v: float, sigma_px: float, inv_depth: float, sigma_inv_depth: float, r: Array, J: Array, E: Array,
) -> int:  # fmt: skip
    """Whitened residual and Jacobian of one observation; returns its rows, 0 where the camera cannot see the point.

    R, p : T_world_body; X (3,) m world; r (3,), J (3, 6) out; E (3, 3) scratch
    J = [dr/dtheta | dr/dX], right perturbation of R; dr/dp = -dr/dX, since only X - p enters.
    """
    dx, dy, dz = X[0] - p[0], X[1] - p[1], X[2] - p[2]
    bx = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
    by = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
    bz = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    ex, ey, ez = bx - p_body_cam[0], by - p_body_cam[1], bz - p_body_cam[2]
    x = R_body_cam[0, 0] * ex + R_body_cam[1, 0] * ey + R_body_cam[2, 0] * ez
    y = R_body_cam[0, 1] * ex + R_body_cam[1, 1] * ey + R_body_cam[2, 1] * ez
    z = R_body_cam[0, 2] * ex + R_body_cam[1, 2] * ey + R_body_cam[2, 2] * ez
    rows = 3 if inv_depth > 0.0 else 2
    if rows == 3 and z < MIN_DEPTH_M:
        return 0
    u_pred, v_pred, seen = project_jacobian(model, params, x, y, z, E)
    if not seen:
        return 0
    scale = 1.0 / sigma_px
    r[0] = (u_pred - u) * scale
    r[1] = (v_pred - v) * scale
    r[2] = 0.0
    if rows == 3:
        r[2] = (1.0 / z - inv_depth) / sigma_inv_depth
        E[2, 2] = -1.0 / (z * z * sigma_inv_depth)
    for i in range(rows):
        if i == 2:
            scale = 1.0
        # m = d r_i / d X_body; then d X_body / dtheta = [X_body]x gives m x X_body, and d X_body / dX = R^T
        mx = scale * (E[i, 0] * R_body_cam[0, 0] + E[i, 1] * R_body_cam[0, 1] + E[i, 2] * R_body_cam[0, 2])
        my = scale * (E[i, 0] * R_body_cam[1, 0] + E[i, 1] * R_body_cam[1, 1] + E[i, 2] * R_body_cam[1, 2])
        mz = scale * (E[i, 0] * R_body_cam[2, 0] + E[i, 1] * R_body_cam[2, 1] + E[i, 2] * R_body_cam[2, 2])
        J[i, 0] = my * bz - mz * by
        J[i, 1] = mz * bx - mx * bz
        J[i, 2] = mx * by - my * bx
        J[i, 3] = R[0, 0] * mx + R[0, 1] * my + R[0, 2] * mz
        J[i, 4] = R[1, 0] * mx + R[1, 1] * my + R[1, 2] * mz
        J[i, 5] = R[2, 0] * mx + R[2, 1] * my + R[2, 2] * mz
    if rows == 2:
        J[2] = 0.0
    return rows


@kernel
def inliers_of(chi2: Array, inv_depth: Array) -> Bools:
    """Which observations lie inside the 95 % bound of their degrees of freedom; chi2 is inf where not seen."""
    out = np.empty(len(chi2), np.bool_)
    for i in range(len(chi2)):
        out[i] = chi2[i] <= (CHI2_PX_DEPTH if inv_depth[i] > 0.0 else CHI2_PX)
    return out
