"""A landmark of inverse depth, held by the frame that saw it first (its anchor), seen by any camera of any frame.

    d = n + a t1 + b t2                     direction in the anchor camera; base = columns (t1, t2, n), unit and square
    Y = R_cj^T (R_j^T (R_i (R_ci d + lambda p_ci) + lambda (p_i - p_j)) - lambda p_cj)
    r = ((u(Y) - u) / sigma_px, (v(Y) - v) / sigma_px, (lambda / Y_z - inv_depth) / sigma_inv_depth)

Y is the point in camera j times lambda, so that a landmark at infinity, lambda = 0, is like any other. All three
(a, b, lambda) are estimated: the anchor's own pixel is a measurement with noise and not the truth. The third row is
there when the observation carries a depth, inv_depth > 0. The second camera of a stereo pair is an observation with
the same frame and another camera: the poses cancel. Derivation: docs/derivations-inertial.md; science note C4.
"""

import math

from lodelight.compiled import kernel
from lodelight.geometry.cameras import project_jacobian, project_point
from lodelight.types import Array

# Columns of a Jacobian: pose i, pose j, (a, b, lambda), camera i on the body, camera j on the body
AT_I, AT_J, AT_LANDMARK, AT_CAMERA_I, AT_CAMERA_J, COLUMNS = 0, 6, 12, 15, 21, 27


@kernel
def inverse_depth_residual(
    model: int, params: Array, Ri: Array, pi: Array, Rci: Array, pci: Array,
    Rj: Array, pj: Array, Rcj: Array, pcj: Array, base: Array, landmark: Array,
    u: float, v: float, sigma_px: float, inv_depth: float, sigma_inv_depth: float, r: Array,
) -> int:  # fmt: skip
    """Fill the whitened r (3,); returns its rows, 0 where the camera cannot see the point."""
    lam = landmark[2]
    d0 = base[0, 0] * landmark[0] + base[0, 1] * landmark[1] + base[0, 2]
    d1 = base[1, 0] * landmark[0] + base[1, 1] * landmark[1] + base[1, 2]
    d2 = base[2, 0] * landmark[0] + base[2, 1] * landmark[1] + base[2, 2]
    b0 = Rci[0, 0] * d0 + Rci[0, 1] * d1 + Rci[0, 2] * d2 + lam * pci[0]
    b1 = Rci[1, 0] * d0 + Rci[1, 1] * d1 + Rci[1, 2] * d2 + lam * pci[1]
    b2 = Rci[2, 0] * d0 + Rci[2, 1] * d1 + Rci[2, 2] * d2 + lam * pci[2]
    w0 = Ri[0, 0] * b0 + Ri[0, 1] * b1 + Ri[0, 2] * b2 + lam * (pi[0] - pj[0])
    w1 = Ri[1, 0] * b0 + Ri[1, 1] * b1 + Ri[1, 2] * b2 + lam * (pi[1] - pj[1])
    w2 = Ri[2, 0] * b0 + Ri[2, 1] * b1 + Ri[2, 2] * b2 + lam * (pi[2] - pj[2])
    y0 = Rj[0, 0] * w0 + Rj[1, 0] * w1 + Rj[2, 0] * w2 - lam * pcj[0]
    y1 = Rj[0, 1] * w0 + Rj[1, 1] * w1 + Rj[2, 1] * w2 - lam * pcj[1]
    y2 = Rj[0, 2] * w0 + Rj[1, 2] * w1 + Rj[2, 2] * w2 - lam * pcj[2]
    x = Rcj[0, 0] * y0 + Rcj[1, 0] * y1 + Rcj[2, 0] * y2
    y = Rcj[0, 1] * y0 + Rcj[1, 1] * y1 + Rcj[2, 1] * y2
    z = Rcj[0, 2] * y0 + Rcj[1, 2] * y1 + Rcj[2, 2] * y2
    u_seen, v_seen, seen = project_point(model, params, x, y, z)
    r[0], r[1], r[2] = (u_seen - u) / sigma_px, (v_seen - v) / sigma_px, 0.0
    # the last is false where something is NaN
    if not seen or (inv_depth > 0.0 and not z > 0.0) or not r[0] * r[0] + r[1] * r[1] < math.inf:
        return 0
    if inv_depth > 0.0:
        r[2] = (lam / z - inv_depth) / sigma_inv_depth
        return 3
    return 2


@kernel
def inverse_depth_jacobian(
    model: int, params: Array, Ri: Array, pi: Array, Rci: Array, pci: Array,
    Rj: Array, pj: Array, Rcj: Array, pcj: Array, base: Array, landmark: Array,
    sigma_px: float, inv_depth: float, sigma_inv_depth: float, E: Array, J: Array,
) -> bool:  # fmt: skip
    """Fill J (3, 27) by the columns named above; False where the camera cannot see the point. E (2, 3) scratch.

    Poses and mountings in the chart of SE3.perturbed. Where frames i and j are one, what stands in the columns of
    both poses sums to nothing.
    """
    lam = landmark[2]
    d0 = base[0, 0] * landmark[0] + base[0, 1] * landmark[1] + base[0, 2]
    d1 = base[1, 0] * landmark[0] + base[1, 1] * landmark[1] + base[1, 2]
    d2 = base[2, 0] * landmark[0] + base[2, 1] * landmark[1] + base[2, 2]
    b0 = Rci[0, 0] * d0 + Rci[0, 1] * d1 + Rci[0, 2] * d2 + lam * pci[0]
    b1 = Rci[1, 0] * d0 + Rci[1, 1] * d1 + Rci[1, 2] * d2 + lam * pci[1]
    b2 = Rci[2, 0] * d0 + Rci[2, 1] * d1 + Rci[2, 2] * d2 + lam * pci[2]
    a0, a1, a2 = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    w0 = Ri[0, 0] * b0 + Ri[0, 1] * b1 + Ri[0, 2] * b2 + lam * a0
    w1 = Ri[1, 0] * b0 + Ri[1, 1] * b1 + Ri[1, 2] * b2 + lam * a1
    w2 = Ri[2, 0] * b0 + Ri[2, 1] * b1 + Ri[2, 2] * b2 + lam * a2
    y0 = Rj[0, 0] * w0 + Rj[1, 0] * w1 + Rj[2, 0] * w2  # in body j
    y1 = Rj[0, 1] * w0 + Rj[1, 1] * w1 + Rj[2, 1] * w2
    y2 = Rj[0, 2] * w0 + Rj[1, 2] * w1 + Rj[2, 2] * w2
    c0, c1, c2 = y0 - lam * pcj[0], y1 - lam * pcj[1], y2 - lam * pcj[2]
    x = Rcj[0, 0] * c0 + Rcj[1, 0] * c1 + Rcj[2, 0] * c2
    y = Rcj[0, 1] * c0 + Rcj[1, 1] * c1 + Rcj[2, 1] * c2
    z = Rcj[0, 2] * c0 + Rcj[1, 2] * c1 + Rcj[2, 2] * c2
    _, _, seen = project_jacobian(model, params, x, y, z, E)
    if not seen or (inv_depth > 0.0 and not z > 0.0):
        return False
    for row in range(3):
        direct = 0.0
        if row < 2:
            e0, e1, e2 = E[row, 0] / sigma_px, E[row, 1] / sigma_px, E[row, 2] / sigma_px
        elif inv_depth > 0.0:
            e0, e1, e2 = 0.0, 0.0, -lam / (z * z * sigma_inv_depth)
            direct = 1.0 / (z * sigma_inv_depth)
        else:
            for c in range(27):
                J[row, c] = 0.0
            break
        # the row carried through the frames: body j, world, body i, camera i
        m0 = Rcj[0, 0] * e0 + Rcj[0, 1] * e1 + Rcj[0, 2] * e2
        m1 = Rcj[1, 0] * e0 + Rcj[1, 1] * e1 + Rcj[1, 2] * e2
        m2 = Rcj[2, 0] * e0 + Rcj[2, 1] * e1 + Rcj[2, 2] * e2
        g0 = Rj[0, 0] * m0 + Rj[0, 1] * m1 + Rj[0, 2] * m2
        g1 = Rj[1, 0] * m0 + Rj[1, 1] * m1 + Rj[1, 2] * m2
        g2 = Rj[2, 0] * m0 + Rj[2, 1] * m1 + Rj[2, 2] * m2
        h0 = Ri[0, 0] * g0 + Ri[1, 0] * g1 + Ri[2, 0] * g2
        h1 = Ri[0, 1] * g0 + Ri[1, 1] * g1 + Ri[2, 1] * g2
        h2 = Ri[0, 2] * g0 + Ri[1, 2] * g1 + Ri[2, 2] * g2
        k0 = Rci[0, 0] * h0 + Rci[1, 0] * h1 + Rci[2, 0] * h2
        k1 = Rci[0, 1] * h0 + Rci[1, 1] * h1 + Rci[2, 1] * h2
        k2 = Rci[0, 2] * h0 + Rci[1, 2] * h1 + Rci[2, 2] * h2
        J[row, 0], J[row, 1], J[row, 2] = b1 * h2 - b2 * h1, b2 * h0 - b0 * h2, b0 * h1 - b1 * h0
        J[row, 3], J[row, 4], J[row, 5] = lam * g0, lam * g1, lam * g2
        J[row, 6], J[row, 7], J[row, 8] = m1 * y2 - m2 * y1, m2 * y0 - m0 * y2, m0 * y1 - m1 * y0
        J[row, 9], J[row, 10], J[row, 11] = -lam * g0, -lam * g1, -lam * g2
        J[row, 12] = k0 * base[0, 0] + k1 * base[1, 0] + k2 * base[2, 0]
        J[row, 13] = k0 * base[0, 1] + k1 * base[1, 1] + k2 * base[2, 1]
        J[row, 14] = (
            direct + h0 * pci[0] + h1 * pci[1] + h2 * pci[2] + g0 * a0 + g1 * a1 + g2 * a2
            - m0 * pcj[0] - m1 * pcj[1] - m2 * pcj[2]
        )  # fmt: skip
        J[row, 15], J[row, 16], J[row, 17] = d1 * k2 - d2 * k1, d2 * k0 - d0 * k2, d0 * k1 - d1 * k0
        J[row, 18], J[row, 19], J[row, 20] = lam * h0, lam * h1, lam * h2
        J[row, 21], J[row, 22], J[row, 23] = e1 * z - e2 * y, e2 * x - e0 * z, e0 * y - e1 * x
        J[row, 24], J[row, 25], J[row, 26] = -lam * m0, -lam * m1, -lam * m2
    return True
