"""The pose of b seen from a: odometry between keyframes, a loop that was closed.

    r = (Log(R_ab^T R_a^T R_b), R_a^T (p_b - p_a) - p_ab), cost r^T information r

so that predicted = measured.perturbed(r), in the chart of SE3.perturbed. Source: science note C5, Q2.
"""

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import matmul, transposed
from lodelight.geometry.so3 import right_jacobian_inverse, so3_log
from lodelight.types import Array


@kernel
def relative_pose(
    Ra: Array, pa: Array, Rb: Array, pb: Array, R_ab: Array, p_ab: Array, r: Array, Ja: Array, Jb: Array
) -> None:  # fmt: skip
    """Fill r (6,), Ja and Jb (6, 6): right perturbation, rotation first, position in world axes."""
    Ra_T = transposed(Ra)
    predicted = matmul(Ra_T, Rb)
    w = so3_log(matmul(transposed(R_ab), predicted))
    J = right_jacobian_inverse(w)
    turned = matmul(J, transposed(predicted))
    x, y, z = pb[0] - pa[0], pb[1] - pa[1], pb[2] - pa[2]
    v = np.empty(3)
    Ja[:] = 0.0
    Jb[:] = 0.0
    for i in range(3):
        v[i] = Ra_T[i, 0] * x + Ra_T[i, 1] * y + Ra_T[i, 2] * z
        r[i], r[3 + i] = w[i], v[i] - p_ab[i]
        for j in range(3):
            Ja[i, j], Jb[i, j] = -turned[i, j], J[i, j]
            Ja[3 + i, 3 + j], Jb[3 + i, 3 + j] = -Ra_T[i, j], Ra_T[i, j]
    Ja[3, 1], Ja[3, 2], Ja[4, 0] = -v[2], v[1], v[2]  # [v]x
    Ja[4, 2], Ja[5, 0], Ja[5, 1] = -v[0], -v[1], v[0]
