"""A pose believed beforehand: from an anchor (light, tag), the last window, or a prediction.

r = (Log(R_mean^T R), p - p_mean), cost r^T information r: the chart of SE3.perturbed around the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import matmul, transposed
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import right_jacobian_inverse, so3_log
from lodelight.types import Array


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of a pose beforehand: information (6, 6) around `mean`, in the chart of SE3.perturbed.

    keyframe : row of the pose in the problem
    """

    keyframe: int
    mean: SE3
    information: Array


@kernel
def add_pose_prior(
    R: Array, p: Array, R_mean: Array, p_mean: Array, information: Array, H: Array, g: Array
) -> float:  # fmt: skip
    """Add J^T information J to H (6, 6) and J^T information r to g (6,); returns r^T information r."""
    w = so3_log(matmul(transposed(R_mean), R))
    Jw = right_jacobian_inverse(w)
    r, J = np.empty(6), np.eye(6)
    for a in range(3):
        r[a], r[3 + a] = w[a], p[a] - p_mean[a]
        for b in range(3):
            J[a, b] = Jw[a, b]
    weighted = matmul(transposed(J), information)
    gained = matmul(weighted, J)
    cost = 0.0
    for a in range(6):
        for b in range(6):
            H[a, b] += gained[a, b]
            g[a] += weighted[a, b] * r[b]
            cost += r[a] * information[a, b] * r[b]
    return cost
