"""Where the corners of a tag are seen from a body, and how that changes with either pose.

X = R_cb (R_wb^T (R_wt s + p_t - p_b) - p_c), u = project(X). Perturbations as everywhere: docs/architecture.md.
Source: science of planar tags, docs/tags.md.
"""

from __future__ import annotations

import numpy as np

from lodelight.geometry.cameras import Camera, project_jacobian
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew
from lodelight.types import Array


def corner_jacobians(
    camera: Camera, T_body_cam: SE3, T_world_body: SE3, T_world_tag: SE3, corners: Array
) -> tuple[Array, Array, Array] | None:
    """Pixels (4, 2) of corners (4, 3) m of the tag's frame, J_body and J_tag (8, 6); None where one is not seen.

    Rows are u and v of each corner in turn; columns rotation first, right perturbation, position in the world.
    """
    px, J_body, J_tag, Jp = np.empty((4, 2)), np.empty((8, 6)), np.empty((8, 6)), np.empty((2, 3))
    R_cb = T_body_cam.R.T
    A = R_cb @ T_world_body.R.T
    for i, s in enumerate(corners):
        X_body = T_world_body.R.T @ (T_world_tag @ s - T_world_body.t)
        X = R_cb @ (X_body - T_body_cam.t)
        u, v, seen = project_jacobian(camera.model, camera.params, X[0], X[1], X[2], Jp)
        if not seen:
            return None
        px[i] = u, v
        rows = slice(2 * i, 2 * i + 2)
        J_body[rows] = Jp @ np.hstack([R_cb @ skew(X_body), -A])
        J_tag[rows] = Jp @ np.hstack([-A @ T_world_tag.R @ skew(s), A])
    return px, J_body, J_tag
