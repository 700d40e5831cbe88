"""A pose believed beforehand: from an anchor (light, tag), the last window, or a prediction.

r = (Log(R_mean^T R), p - p_mean), cost r^T information r: the chart of SE3.perturbed around the mean.
"""

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.so3 import right_jacobian_inverse, so3_log
from lodelight.types import Array


@kernel
def add_pose_prior(
    R: Array, p: Array, R_mean: Array, p_mean: Array, information: Array, H: Array, g: Array
) -> float:  # fmt: skip
    """Add J^T information J to H (6, 6) and J^T information r to g (6,); returns r^T information r."""
    w = so3_log(np.ascontiguousarray(R_mean.T) @ R)
    r = np.empty(6)
    r[:3] = w
    r[3:] = p - p_mean
    J = np.eye(6)
    J[:3, :3] = right_jacobian_inverse(w)
    weighted = information @ r
    H += J.T @ information @ J
    g += J.T @ weighted
    return float(r @ weighted)
