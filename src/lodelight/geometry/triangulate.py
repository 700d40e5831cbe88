"""Points from the rays that see them.

The point X nearest to the rays (c_i, f_i), each weighted by what its angle says at the distance d_i of the point:

    X = argmin sum_i |(I - f_i f_i^T)(X - c_i)|^2 / (sigma_i d_i)^2

It is linear but for d_i, so a few repetitions reach the least angular error; the inverse of its matrix is the
covariance of X. Rays and not pixels: any lens. Source: the weighted midpoint; Hartley and Sturm 1997 on why to weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import inverse3
from lodelight.geometry.se3 import SE3
from lodelight.types import AnyArray, Array, Bools

REPETITIONS = 3
# 95 % of a chi-square distribution with 1 degree of freedom: 2 rays measure 4 numbers and X takes 3 of them
CHI2_PAIR = 3.841


@dataclass(frozen=True, eq=False)
class Triangulated:
    """M points, each of its own rays.

    xyz : (M, 3) m; NaN where the rays are parallel or only one
    covariance : (M, 3, 3) m^2
    parallax : (M,) rad, the largest angle between two of its rays
    relative_sigma : (M,) root of the covariance's trace (nearly all of it along the ray) over the distance from the
                     first centre
    in_front : (M,) the point lies ahead on all its rays
    chi2 : (M,) squared angular errors over their sigmas, 2 per ray - 3 degrees of freedom
    """

    xyz: Array
    covariance: Array
    parallax: Array
    relative_sigma: Array
    in_front: Bools
    chi2: Array


def triangulate_rays(centres: AnyArray, rays: AnyArray, sigma_rad: AnyArray, start: AnyArray) -> Triangulated:
    """M points from N rays; point m owns rows start[m] to start[m + 1].

    centres, rays : (N, 3) m and unit vectors in one frame, which is that of the answer
    sigma_rad : (N,) angular standard deviation of a ray; start : (M + 1,) rising
    """
    c, f, s = (np.ascontiguousarray(a, dtype=np.float64) for a in (centres, rays, sigma_rad))
    return Triangulated(*_triangulate(c, f, s, np.ascontiguousarray(start, dtype=np.int64)))


def triangulate_pairs(
    T_world_a: SE3,
    rays_a: AnyArray,
    sigma_a: AnyArray,
    T_world_b: SE3,
    rays_b: AnyArray,
    sigma_b: AnyArray,
    max_relative_sigma: float = 0.2,
    min_parallax: float = 0.0,
) -> tuple[Array, Bools]:
    """World points (N, 3) m from rays matched between two cameras, and which of them are to be trusted.

    rays_a, rays_b : (N, 3) unit vectors in their own camera's frame; sigma_a, sigma_b : (N,) rad
    Trusted: ahead of both cameras, the rays meet within the 95 % bound of their noise, and the distance is known to
    better than `max_relative_sigma` of itself, which is a bound on the parallax in units of the noise; the parallax
    itself is at least `min_parallax` rad, for where the cameras' own places are in doubt.
    """
    n = len(rays_a)
    centres, rays, sigma = np.empty((n, 2, 3)), np.empty((n, 2, 3)), np.empty((n, 2))
    for k, (T, f, s) in enumerate(((T_world_a, rays_a, sigma_a), (T_world_b, rays_b, sigma_b))):
        centres[:, k], rays[:, k], sigma[:, k] = T.t, f @ T.R.T, s
    found = triangulate_rays(centres.reshape(-1, 3), rays.reshape(-1, 3), sigma.ravel(), np.arange(0, 2 * n + 1, 2))
    good = found.in_front & (found.chi2 < CHI2_PAIR) & (found.relative_sigma < max_relative_sigma)
    good &= found.parallax >= min_parallax
    return found.xyz, good


@kernel
def _triangulate(
    c: Array, f: Array, sigma: Array, start: AnyArray
) -> tuple[Array, Array, Array, Array, Bools, Array]:  # fmt: skip
    m = len(start) - 1
    xyz, covariance, parallax = np.full((m, 3), math.nan), np.full((m, 3, 3), math.inf), np.zeros(m)
    relative, in_front, chi2 = np.full(m, math.inf), np.zeros(m, np.bool_), np.full(m, math.inf)
    distance = np.ones(len(c))
    for k in range(m):
        lo, hi = start[k], start[k + 1]
        if hi - lo < 2:
            continue
        x = y = z = 0.0  # relative to the first centre: cameras far from the origin cost no digits
        for _ in range(REPETITIONS):
            a00 = a10 = a11 = a20 = a21 = a22 = b0 = b1 = b2 = 0.0
            for i in range(lo, hi):
                w = 1.0 / (sigma[i] * distance[i]) ** 2
                fx, fy, fz = f[i, 0], f[i, 1], f[i, 2]
                cx, cy, cz = c[i, 0] - c[lo, 0], c[i, 1] - c[lo, 1], c[i, 2] - c[lo, 2]
                along = fx * cx + fy * cy + fz * cz
                a00 += w * (1.0 - fx * fx)
                a11 += w * (1.0 - fy * fy)
                a22 += w * (1.0 - fz * fz)
                a10 -= w * fx * fy
                a20 -= w * fx * fz
                a21 -= w * fy * fz
                b0 += w * (cx - along * fx)
                b1 += w * (cy - along * fy)
                b2 += w * (cz - along * fz)
            v00, v10, v11, v20, v21, v22 = inverse3(a00, a10, a11, a20, a21, a22)
            x = v00 * b0 + v10 * b1 + v20 * b2
            y = v10 * b0 + v11 * b1 + v21 * b2
            z = v20 * b0 + v21 * b1 + v22 * b2
            for i in range(lo, hi):
                dx, dy, dz = x - c[i, 0] + c[lo, 0], y - c[i, 1] + c[lo, 1], z - c[i, 2] + c[lo, 2]
                distance[i] = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
        if v22 == 0.0:
            continue
        xyz[k, 0], xyz[k, 1], xyz[k, 2] = x + c[lo, 0], y + c[lo, 1], z + c[lo, 2]
        V = covariance[k]
        V[0, 0], V[1, 1], V[2, 2] = v00, v11, v22
        V[0, 1] = V[1, 0] = v10
        V[0, 2] = V[2, 0] = v20
        V[1, 2] = V[2, 1] = v21
        relative[k] = math.sqrt(v00 + v11 + v22) / distance[lo]
        in_front[k], chi2[k] = True, 0.0
        for i in range(lo, hi):
            dx, dy, dz = xyz[k, 0] - c[i, 0], xyz[k, 1] - c[i, 1], xyz[k, 2] - c[i, 2]
            along = f[i, 0] * dx + f[i, 1] * dy + f[i, 2] * dz
            in_front[k] = in_front[k] and along > 0.0
            off2 = max(dx * dx + dy * dy + dz * dz - along * along, 0.0)
            chi2[k] += off2 / (sigma[i] * distance[i]) ** 2
            for j in range(lo, i):
                cosine = f[i, 0] * f[j, 0] + f[i, 1] * f[j, 1] + f[i, 2] * f[j, 2]
                parallax[k] = max(parallax[k], math.acos(min(max(cosine, -1.0), 1.0)))
    return xyz, covariance, parallax, relative, in_front, chi2
