"""A camera's pose from three points and the rays that see them: up to four solutions.

Unknown are the distances along the rays, L = (l0, l1, l2) > 0, of which every pair says

    |l_i y_i - l_j y_j|^2 = |x_i - x_j|^2.

Two combinations of these are homogeneous in L, two quadratic forms D and E; some D + g E is singular (a cubic in g)
and so a pair of planes; either plane meets D in two lines. Idea: Persson and Nordberg, "Lambda Twist", ECCV 2018; here
the planes and the lines are both found by splitting a binary quadratic form. Tuples and not arrays: no allocation.
"""

import math
from typing import TypeAlias

import numpy as np

from lodelight.compiled import kernel
from lodelight.types import Array

Vector: TypeAlias = tuple[float, float, float]
Form: TypeAlias = tuple[float, float, float, float, float, float]  # symmetric 3x3: 00 01 02 11 12 22


@kernel
def p3p(rays: Array, xyz: Array, R: Array, c: Array) -> int:
    """Fill R (4, 3, 3) and c (4, 3), T_world_cam of each solution; returns how many there are.

    rays (3, 3) unit, camera frame; xyz (3, 3) m, world, one per row
    """
    y0, y1, y2 = _row(rays, 0), _row(rays, 1), _row(rays, 2)
    b01, b02, b12 = _dot(y0, y1), _dot(y0, y2), _dot(y1, y2)
    a01, a02, a12 = _distance2(xyz, 0, 1), _distance2(xyz, 0, 2), _distance2(xyz, 1, 2)
    if min(a01, a02, a12) <= 0.0:
        return 0
    D = (a12, -a12 * b01, 0.0, a12 - a01, a01 * b12, -a01)
    E = (a12, 0.0, -a12 * b02, -a02, a02 * b12, a12 - a02)
    c0, c3 = _determinant(D), _determinant(E)
    if abs(c3) < abs(c0):  # the leading coefficient must not vanish
        D, E, c0, c3 = E, D, c3, c0
    if c3 == 0.0:
        return 0
    plus, minus = _determinant(_combine(D, E, 1.0)), _determinant(_combine(D, E, -1.0))
    g = _separate_root(0.5 * (plus + minus) / c3 - c0 / c3, 0.5 * (plus - minus) / c3 - 1.0, c0 / c3)
    planes = _combine(D, E, g)
    if abs(g) < 1.0:  # on the planes D = -g E: take the larger
        D = E
    apex, e, f = _null_space(planes)
    real, s0, t0, s1, t1 = _split(_value(planes, e, e), _value(planes, e, f), _value(planes, f, f))
    if not real:
        return 0
    count = 0
    for s, t in ((s0, t0), (s1, t1)):
        h = _sum(s, e, t, f)
        real, u0, v0, u1, v1 = _split(_value(D, apex, apex), _value(D, apex, h), _value(D, h, h))
        if not real:
            continue
        for u, v in ((u0, v0), (u1, v1)):
            x, y, z = _sum(u, apex, v, h)
            size2 = 2.0 * (x * x + y * y + z * z - b01 * x * y - b02 * x * z - b12 * y * z)
            k = math.copysign(math.sqrt((a01 + a02 + a12) / size2), x)
            x, y, z = _polish(k * x, k * y, k * z, a01, a02, a12, b01, b02, b12)
            if x > 0.0 and y > 0.0 and z > 0.0:
                seen = np.empty((3, 3))
                for a in range(3):
                    seen[0, a], seen[1, a], seen[2, a] = x * y0[a], y * y1[a], z * y2[a]
                count += triangle_pose(seen, xyz, R[count], c[count])
    return count


@kernel
def triangle_pose(seen: Array, xyz: Array, R: Array, c: Array) -> int:
    """R (3, 3), c (3,) of T_world_cam from a triangle in camera (3, 3) and world (3, 3); 0 if it is a line, else 1."""
    a0, a1, a2, triangle_a = _triad(seen)
    b0, b1, b2, triangle_b = _triad(xyz)
    for i in range(3):
        for j in range(3):
            R[i, j] = b0[i] * a0[j] + b1[i] * a1[j] + b2[i] * a2[j]
    for i in range(3):
        c[i] = 0.0
        for k in range(3):
            c[i] += (xyz[k, i] - R[i, 0] * seen[k, 0] - R[i, 1] * seen[k, 1] - R[i, 2] * seen[k, 2]) / 3.0
    return 1 if triangle_a and triangle_b else 0


@kernel
def _triad(p: Array) -> tuple[Vector, Vector, Vector, bool]:
    """Orthonormal vectors that turn with a triangle, and whether it is one."""
    e, f = _sum(1.0, _row(p, 1), -1.0, _row(p, 0)), _sum(1.0, _row(p, 2), -1.0, _row(p, 0))
    n = _cross(e, f)
    e2, n2 = _dot(e, e), _dot(n, n)
    if not n2 > 1e-12 * e2 * _dot(f, f):  # three points on a line, to a millionth
        return e, f, n, False
    e = _sum(1.0 / math.sqrt(e2), e, 0.0, e)
    n = _sum(1.0 / math.sqrt(n2), n, 0.0, n)
    return e, _cross(n, e), n, True


@kernel
def _row(m: Array, i: int) -> Vector:
    return m[i, 0], m[i, 1], m[i, 2]


@kernel
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def _sum(s: float, a: Vector, t: float, b: Vector) -> Vector:
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@kernel
def _distance2(p: Array, i: int, j: int) -> float:
    return float((p[i, 0] - p[j, 0]) ** 2 + (p[i, 1] - p[j, 1]) ** 2 + (p[i, 2] - p[j, 2]) ** 2)


@kernel
def _combine(D: Form, E: Form, g: float) -> Form:
    return D[0] + g * E[0], D[1] + g * E[1], D[2] + g * E[2], D[3] + g * E[3], D[4] + g * E[4], D[5] + g * E[5]


@kernel
def _determinant(D: Form) -> float:
    return (
        D[0] * (D[3] * D[5] - D[4] * D[4])
        - D[1] * (D[1] * D[5] - D[4] * D[2])
        + D[2] * (D[1] * D[4] - D[3] * D[2])
    )  # fmt: skip


@kernel
def _value(D: Form, a: Vector, b: Vector) -> float:
    """a^T D b"""
    return (
        a[0] * (D[0] * b[0] + D[1] * b[1] + D[2] * b[2])
        + a[1] * (D[1] * b[0] + D[3] * b[1] + D[4] * b[2])
        + a[2] * (D[2] * b[0] + D[4] * b[1] + D[5] * b[2])
    )


@kernel
def _separate_root(b: float, c: float, d: float) -> float:
    """Of the real roots of x^3 + b x^2 + c x + d one that is far from the others."""
    p, q = c - b * b / 3.0, 2.0 * b * b * b / 27.0 - b * c / 3.0 + d
    under = q * q / 4.0 + p * p * p / 27.0
    if under > 0.0:  # one: the larger of Cardano's two cube roots gives the other without cancellation
        root = -math.copysign(abs(q) / 2.0 + math.sqrt(under), q)
        cube = math.copysign(abs(root) ** (1.0 / 3.0), root)
        x = cube - p / (3.0 * cube)
    else:  # three, r cos(angle): the largest or the smallest, whichever has the middle one farther away
        r = 2.0 * math.sqrt(max(-p, 0.0) / 3.0)
        angle = math.acos(min(max(3.0 * q / (p * r), -1.0), 1.0)) / 3.0 if p * r < 0.0 else 0.0
        x = r * math.cos(angle) if q < 0.0 else r * math.cos(angle + 2.0 * math.pi / 3.0)
    x -= b / 3.0
    for _ in range(3):
        slope = (3.0 * x + 2.0 * b) * x + c
        if slope == 0.0:
            break
        x -= (((x + b) * x + c) * x + d) / slope
    return x


@kernel
def _null_space(D: Form) -> tuple[Vector, Vector, Vector]:
    """The null vector of a singular form, and two unit vectors across it."""
    r0, r1, r2 = (D[0], D[1], D[2]), (D[1], D[3], D[4]), (D[2], D[4], D[5])
    n, size = (0.0, 0.0, 1.0), 0.0
    for a, b in ((r0, r1), (r0, r2), (r1, r2)):
        x = _cross(a, b)
        if _dot(x, x) > size:
            n, size = x, _dot(x, x)
    length = math.sqrt(_dot(n, n))
    n = _sum(1.0 / length, n, 0.0, n)
    if abs(n[0]) > 0.6:
        e = (-n[1], n[0], 0.0)
    else:
        e = (0.0, -n[2], n[1])
    e = _sum(1.0 / math.sqrt(_dot(e, e)), e, 0.0, e)
    return n, e, _cross(n, e)


@kernel
def _split(a: float, b: float, c: float) -> tuple[bool, float, float, float, float]:
    """The two lines (s, t) on which a s^2 + 2 b s t + c t^2 = 0, if they are real."""
    under = b * b - a * c
    if under < 0.0:
        return False, 0.0, 0.0, 0.0, 0.0
    q = -(b + math.copysign(math.sqrt(under), b))  # no cancellation: s / t = q / a and c / q
    if q == 0.0:
        return True, 1.0, 0.0, 0.0, 1.0
    return True, q, a, c, q


@kernel
def _polish(
    x: float, y: float, z: float, a01: float, a02: float, a12: float, b01: float, b02: float, b12: float
) -> Vector:  # fmt: skip
    """Newton's method on the three distances."""
    for _ in range(2):
        r0 = x * x + y * y - 2.0 * b01 * x * y - a01
        r1 = x * x + z * z - 2.0 * b02 * x * z - a02
        r2 = y * y + z * z - 2.0 * b12 * y * z - a12
        # half the Jacobian: [[p, q, 0], [r, 0, s], [0, t, u]]
        p, q, r, s, t, u = x - b01 * y, y - b01 * x, x - b02 * z, z - b02 * x, y - b12 * z, z - b12 * y
        det = -p * s * t - q * r * u
        if det == 0.0:
            break
        k = 0.5 / det
        x, y, z = (
            x - k * (-s * t * r0 - q * u * r1 + q * s * r2),
            y - k * (-r * u * r0 + p * u * r1 - p * s * r2),
            z - k * (r * t * r0 - p * t * r1 - q * r * r2),
        )
    return x, y, z
