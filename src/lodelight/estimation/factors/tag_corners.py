"""A corner of a tag, seen by a camera: the tag's pose surveyed, believed or unknown.

    X = R_c^T (R^T (R_t s + p_t - p) - p_c),   r = ((u(X) - u) / sigma_px, (v(X) - v) / sigma_px)

s is the corner in the tag's frame; its size carries the metric scale. Derivation: docs/derivations-inertial.md.
Source: science note C5, Q1.
"""

import math

from lodelight.compiled import kernel
from lodelight.geometry.cameras import project_jacobian, project_point
from lodelight.types import Array

CHI2_TAG = 15.507  # 95 % of a chi-square distribution with 8 degrees of freedom, those of four corners
# Columns of a Jacobian: pose of the body, pose of the tag, camera on the body
AT_BODY, AT_TAG, AT_CAMERA, COLUMNS = 0, 6, 12, 18


@kernel
def tag_corner_residual(
    model: int, params: Array, R: Array, p: Array, Rc: Array, pc: Array, Rt: Array, pt: Array,
    s0: float, s1: float, s2: float, u: float, v: float, sigma_px: float, r: Array,
) -> bool:  # fmt: skip
    """Fill the whitened r (2,); False where the camera cannot see the corner."""
    w0 = Rt[0, 0] * s0 + Rt[0, 1] * s1 + Rt[0, 2] * s2 + pt[0] - p[0]
    w1 = Rt[1, 0] * s0 + Rt[1, 1] * s1 + Rt[1, 2] * s2 + pt[1] - p[1]
    w2 = Rt[2, 0] * s0 + Rt[2, 1] * s1 + Rt[2, 2] * s2 + pt[2] - p[2]
    b0 = R[0, 0] * w0 + R[1, 0] * w1 + R[2, 0] * w2 - pc[0]
    b1 = R[0, 1] * w0 + R[1, 1] * w1 + R[2, 1] * w2 - pc[1]
    b2 = R[0, 2] * w0 + R[1, 2] * w1 + R[2, 2] * w2 - pc[2]
    x = Rc[0, 0] * b0 + Rc[1, 0] * b1 + Rc[2, 0] * b2
    y = Rc[0, 1] * b0 + Rc[1, 1] * b1 + Rc[2, 1] * b2
    z = Rc[0, 2] * b0 + Rc[1, 2] * b1 + Rc[2, 2] * b2
    u_seen, v_seen, seen = project_point(model, params, x, y, z)
    r[0], r[1] = (u_seen - u) / sigma_px, (v_seen - v) / sigma_px
    return seen and r[0] * r[0] + r[1] * r[1] < math.inf


@kernel
def tag_corner_jacobian(
    model: int, params: Array, R: Array, p: Array, Rc: Array, pc: Array, Rt: Array, pt: Array,
    s0: float, s1: float, s2: float, sigma_px: float, E: Array, J: Array,
) -> bool:  # fmt: skip
    """Fill J (2, 18) by the columns named above, in the chart of SE3.perturbed. E (2, 3) scratch."""
    w0 = Rt[0, 0] * s0 + Rt[0, 1] * s1 + Rt[0, 2] * s2 + pt[0] - p[0]
    w1 = Rt[1, 0] * s0 + Rt[1, 1] * s1 + Rt[1, 2] * s2 + pt[1] - p[1]
    w2 = Rt[2, 0] * s0 + Rt[2, 1] * s1 + Rt[2, 2] * s2 + pt[2] - p[2]
    y0 = R[0, 0] * w0 + R[1, 0] * w1 + R[2, 0] * w2
    y1 = R[0, 1] * w0 + R[1, 1] * w1 + R[2, 1] * w2
    y2 = R[0, 2] * w0 + R[1, 2] * w1 + R[2, 2] * w2
    b0, b1, b2 = y0 - pc[0], y1 - pc[1], y2 - pc[2]
    x = Rc[0, 0] * b0 + Rc[1, 0] * b1 + Rc[2, 0] * b2
    y = Rc[0, 1] * b0 + Rc[1, 1] * b1 + Rc[2, 1] * b2
    z = Rc[0, 2] * b0 + Rc[1, 2] * b1 + Rc[2, 2] * b2
    _, _, seen = project_jacobian(model, params, x, y, z, E)
    if not seen:
        return False
    for row in range(2):
        e0, e1, e2 = E[row, 0] / sigma_px, E[row, 1] / sigma_px, E[row, 2] / sigma_px
        m0 = Rc[0, 0] * e0 + Rc[0, 1] * e1 + Rc[0, 2] * e2
        m1 = Rc[1, 0] * e0 + Rc[1, 1] * e1 + Rc[1, 2] * e2
        m2 = Rc[2, 0] * e0 + Rc[2, 1] * e1 + Rc[2, 2] * e2
        g0 = R[0, 0] * m0 + R[0, 1] * m1 + R[0, 2] * m2
        g1 = R[1, 0] * m0 + R[1, 1] * m1 + R[1, 2] * m2
        g2 = R[2, 0] * m0 + R[2, 1] * m1 + R[2, 2] * m2
        t0 = Rt[0, 0] * g0 + Rt[1, 0] * g1 + Rt[2, 0] * g2
        t1 = Rt[0, 1] * g0 + Rt[1, 1] * g1 + Rt[2, 1] * g2
        t2 = Rt[0, 2] * g0 + Rt[1, 2] * g1 + Rt[2, 2] * g2
        J[row, 0], J[row, 1], J[row, 2] = m1 * y2 - m2 * y1, m2 * y0 - m0 * y2, m0 * y1 - m1 * y0
        J[row, 3], J[row, 4], J[row, 5] = -g0, -g1, -g2
        J[row, 6], J[row, 7], J[row, 8] = s1 * t2 - s2 * t1, s2 * t0 - s0 * t2, s0 * t1 - s1 * t0
        J[row, 9], J[row, 10], J[row, 11] = g0, g1, g2
        J[row, 12], J[row, 13], J[row, 14] = e1 * z - e2 * y, e2 * x - e0 * z, e0 * y - e1 * x
        J[row, 15], J[row, 16], J[row, 17] = -m0, -m1, -m2
    return True
