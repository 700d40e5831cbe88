"""How much of a pose hangs on each of the points it was had from, and which of them nothing else tests.

The leverage of an observation is the share of its own prediction that is its own doing: h = w J P J^T, where P is the
covariance of the pose from all of them, J its rows and w its weight. The others predict it to sigma / sqrt(1 - h), and
a wrong match that passes its test there moves the pose by up to sqrt(h / (1 - h)) of the pose's own 95 % bound. Above
one half that is more than the pose owns to: such a point decides by itself. It is mostly a point mapped too close to
the camera, which fits wherever it is found. Source: Huber, "Robust statistics", 1981, ch. 7 (leverage points).
"""

from __future__ import annotations

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.factors.reprojection import reprojection
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.types import AnyArray, Array

MOST = 0.5  # of what predicts an observation may be itself


def leverage(
    T_world_body: SE3, T_body_cam: SE3, camera: Camera, xyz: AnyArray, px: AnyArray, sigma_px: AnyArray,
    inv_depth: AnyArray, sigma_inv_depth: AnyArray, weight: AnyArray,
) -> Array:  # fmt: skip
    """(N,) leverage of every observation on the pose, in the direction where it is largest: what is above MOST is
    exact, and what is said to be below is at most as large as said.

    As for `optimize_pose`; weight : (N,) information weight, 0 where an observation has no say
    """
    J = _rows(
        camera.model, camera.params, T_world_body.R, T_world_body.t, T_body_cam.R, T_body_cam.t,
        *(np.ascontiguousarray(a, np.float64) for a in (xyz, px, sigma_px, inv_depth, sigma_inv_depth)),
    )  # fmt: skip
    J *= np.sqrt(weight)[:, None, None]
    information = np.einsum("nia,nib->ab", J, J)
    hat = np.einsum("nia,ab,njb->nij", J, np.linalg.pinv(information, hermitian=True), J)
    out: Array = np.einsum("nii->n", hat).copy()
    large = np.flatnonzero(out > MOST)  # a trace is no less than the largest eigenvalue
    out[large] = np.linalg.eigvalsh(hat[large])[:, -1]
    return out


@kernel
def _rows(
    model: int, params: Array, R: Array, p: Array, R_body_cam: Array, p_body_cam: Array,
    xyz: Array, px: Array, sigma_px: Array, inv_depth: Array, sigma_inv_depth: Array,
) -> Array:  # fmt: skip
    """(N, 3, 6) Jacobians by the pose, zero where there is no such row."""
    J = np.zeros((len(xyz), 3, 6))
    E = np.zeros((2, 3))
    for i in range(len(xyz)):
        _, _, Ju, Jv, Jd = reprojection(
            model, params, R, p, R_body_cam, p_body_cam, xyz[i, 0], xyz[i, 1], xyz[i, 2], px[i, 0], px[i, 1],
            sigma_px[i], inv_depth[i], sigma_inv_depth[i], E,
        )  # fmt: skip
        for a in range(6):
            sign = 1.0 if a < 3 else -1.0  # dr/dp = -dr/dX
            J[i, 0, a], J[i, 1, a], J[i, 2, a] = sign * Ju[a], sign * Jv[a], sign * Jd[a]
    return J
