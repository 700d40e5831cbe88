"""The gyroscope's bias from how images turn against one another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lodelight.geometry.so3 import so3_log
from lodelight.imu.preintegration import Preintegration
from lodelight.types import Array

HUBER_SIGMAS = 2.0


def gyro_bias(motions: Sequence[Preintegration], R_seen: Sequence[Array]) -> tuple[Array, float]:
    """Bias (3,) rad/s that explains the rotations of the body (3, 3) seen during each motion, and what is left, rad.

    The difference of a motion's rotation to what was seen is its Jacobian times the bias that was left out. Robust:
    one rotation that was seen wrong does not matter. What is left is the median of the differences' norms.
    """
    change = np.zeros(3)
    bias = motions[0].bias_gyro
    J = np.stack([m.jacobian[:3, :3] for m in motions])
    r = np.stack([so3_log(np.ascontiguousarray(m.dR.T @ R)) for m, R in zip(motions, R_seen, strict=True)])
    norm = np.zeros(len(r))
    for _ in range(5):
        norm = np.linalg.norm(r - J @ change, axis=1)
        bound = HUBER_SIGMAS * max(float(np.median(norm)), 1e-9)
        w = np.minimum(1.0, bound / np.maximum(norm, 1e-12))
        H = np.einsum("n,nji,njk->ik", w, J, J) + 1e-12 * np.eye(3)
        change = np.linalg.solve(H, np.einsum("n,nji,nj->i", w, J, r))
    return bias + change, float(np.median(norm))
