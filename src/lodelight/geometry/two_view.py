"""Which rays of two views agree on one motion, where the rotation is nearly known, as by a gyroscope.

A point seen along a and b gives, with g = R_b_a a, the normal n = g x b of its epipolar plane, and the baseline lies
in all these planes: t . n = 0. So two points give a direction, t = n_1 x n_2, and the angle of b out of the plane of
t and g is e = t . n / |t x g|. The best of many draws is refined over the baseline's direction and a small turn d of
the rotation, g <- g + d x g, held by a prior; so a gyroscope's bias, or a rotation that is only a guess, does no harm.
Unit rays and not pixels: any lens. Source: the two-point case of Nister 2004; Kneip and Lynen 2013 on normals.
"""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import cholesky, cholesky_solve, matmul
from lodelight.geometry.so3 import so3_exp
from lodelight.types import Array, Bools

DRAWS = 60
REFINEMENTS = 4
MIN_PAIRS = 6  # fewer points do not tell a turn from a shift
NEAR_BASELINE = 0.02  # sine of the angle from the baseline, below which a ray's plane is not defined


@kernel
def fit_two_view(
    ray_a: Array, ray_b: Array, R_b_a: Array, sigma_rotation: float, sigma_ray: float, bound: float, seed: int
) -> tuple[Array, Array, Bools, float]:  # fmt: skip
    """The motion most pairs of rays agree on.

    ray_a, ray_b : (N, 3) unit rays of the same points; R_b_a (3, 3) as believed, each axis within sigma_rotation rad
    sigma_ray : rad, noise of a ray; bound : an angle out of the epipolar plane above bound * sigma_ray is an outlier
    Returns R_b_a (3, 3), t (3,) the unit direction of a's centre seen from b (its sign is chosen so that most points
    lie ahead), inlier (N,), and the median parallax of the inliers, rad. Too few pairs: all are inliers, t is zero.
    """
    n = len(ray_a)
    R, t = R_b_a.copy(), np.zeros(3)
    inlier = np.ones(n, np.bool_)
    if n < MIN_PAIRS:
        return R, t, inlier, 0.0
    g, normal = np.empty((n, 3)), np.empty((n, 3))
    _normals(ray_a, ray_b, R, g, normal)
    loose = bound * math.sqrt(sigma_ray * sigma_ray + sigma_rotation * sigma_rotation)
    state = np.uint64(seed)
    best, trial = math.inf, np.empty(3)
    for _ in range(DRAWS):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        i = int((state >> np.uint64(33)) % np.uint64(n))
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        j = int((state >> np.uint64(33)) % np.uint64(n))
        _cross(normal[i], normal[j], trial)
        length = math.sqrt(trial[0] ** 2 + trial[1] ** 2 + trial[2] ** 2)
        if length < 1e-14:
            continue
        for k in range(3):
            trial[k] /= length
        score = 0.0
        for k in range(n):
            e = _angle(trial, g[k], normal[k])
            score += min(e * e, loose * loose)
        if score < best:
            best = score
            t[:] = trial
    limit = loose
    for _ in range(REFINEMENTS):
        _refine(ray_b, g, normal, R, R_b_a, t, sigma_rotation, sigma_ray, limit)
        _normals(ray_a, ray_b, R, g, normal)
        limit = max(0.5 * limit, bound * sigma_ray)
    parallax, ahead, count = np.empty(n), 0, 0
    for k in range(n):
        inlier[k] = abs(_angle(t, g[k], normal[k])) < bound * sigma_ray
        if inlier[k]:
            parallax[count] = math.sqrt(normal[k, 0] ** 2 + normal[k, 1] ** 2 + normal[k, 2] ** 2)
            count += 1
            # l_b b - l_a g = t: the point is ahead of a where g x t and g x b point the same way
            x, y, z = g[k, 1] * t[2] - g[k, 2] * t[1], g[k, 2] * t[0] - g[k, 0] * t[2], g[k, 0] * t[1] - g[k, 1] * t[0]
            ahead += 1 if x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2] > 0.0 else -1
    if ahead < 0:
        t = -t
    return R, t, inlier, float(np.median(parallax[:count])) if count else 0.0


@kernel
def epipolar_noise(ray_a: Array, ray_b: Array, R_b_a: Array, t: Array, unit: Array) -> float:
    """Deviation, rad, of rays (N, 3) of two views out of their epipolar planes, in units (N,) of their own: 1.48 times
    the median, so that wrong ones have no say. NaN for fewer than MIN_PAIRS."""
    n, count = len(ray_a), 0
    g, normal, e = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    _normals(ray_a, ray_b, R_b_a, g, normal)
    for k in range(n):
        x, y, z = t[1] * g[k, 2] - t[2] * g[k, 1], t[2] * g[k, 0] - t[0] * g[k, 2], t[0] * g[k, 1] - t[1] * g[k, 0]
        if x * x + y * y + z * z > NEAR_BASELINE * NEAR_BASELINE:
            e[count] = abs(_angle(t, g[k], normal[k])) / unit[k]
            count += 1
    return 1.4826 * float(np.median(e[:count])) if count >= MIN_PAIRS else math.nan


@kernel
def turn_between(ray_a: Array, ray_b: Array) -> Array:
    """R_b_a (3, 3) that brings most rays of a onto those of b: nearly right where the translation moves them little.

    Reweighted least squares with Cauchy's kernel at the median error.
    """
    R = np.eye(3)
    n = len(ray_a)
    error, g, c = np.empty(n), np.empty((n, 3)), np.empty((n, 3))
    for _ in range(10):
        _normals(ray_a, ray_b, R, g, c)
        for k in range(n):
            error[k] = c[k, 0] ** 2 + c[k, 1] ** 2 + c[k, 2] ** 2
        scale = max(float(np.median(error)), 1e-10) if n else 1.0
        H, d = np.zeros((3, 3)), np.zeros(3)
        for k in range(n):
            w = 1.0 / (1.0 + error[k] / scale)
            for i in range(3):
                d[i] += w * c[k, i]
                H[i, i] += w
                for j in range(i + 1):
                    H[i, j] -= w * g[k, i] * g[k, j]
        for i in range(3):
            H[i, i] += 1e-9
        if not cholesky(H):
            break
        cholesky_solve(H, d)
        R = matmul(so3_exp(d), R)
        if d[0] ** 2 + d[1] ** 2 + d[2] ** 2 < 1e-14:
            break
    return R


@kernel
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def _normals(ray_a: Array, ray_b: Array, R: Array, g: Array, normal: Array) -> None:
    for k in range(len(ray_a)):
        for i in range(3):
            g[k, i] = R[i, 0] * ray_a[k, 0] + R[i, 1] * ray_a[k, 1] + R[i, 2] * ray_a[k, 2]
        _cross(g[k], ray_b[k], normal[k])


@kernel
def _angle(t: Array, g: Array, normal: Array) -> float:
    """Of b out of the plane of t and g, rad; near the baseline, of b from g."""
    x, y, z = t[1] * g[2] - t[2] * g[1], t[2] * g[0] - t[0] * g[2], t[0] * g[1] - t[1] * g[0]
    length = math.sqrt(x * x + y * y + z * z)
    if length < NEAR_BASELINE:
        return math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    return float((t[0] * normal[0] + t[1] * normal[1] + t[2] * normal[2]) / length)


@kernel
def _refine(
    ray_b: Array, g: Array, normal: Array, R: Array, R_believed: Array, t: Array,
    sigma_rotation: float, sigma_ray: float, limit: float,
) -> None:  # fmt: skip
    """One Gauss-Newton step on R and t, written in place; `limit` rad: what is out farther has no say."""
    H, b, J = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    for k in range(len(g)):
        e = _angle(t, g[k], normal[k])
        x, y, z = t[1] * g[k, 2] - t[2] * g[k, 1], t[2] * g[k, 0] - t[0] * g[k, 2], t[0] * g[k, 1] - t[1] * g[k, 0]
        length = math.sqrt(x * x + y * y + z * z)
        if length < NEAR_BASELINE or abs(e) > limit:
            continue
        tg = t[0] * g[k, 0] + t[1] * g[k, 1] + t[2] * g[k, 2]
        gb = g[k, 0] * ray_b[k, 0] + g[k, 1] * ray_b[k, 1] + g[k, 2] * ray_b[k, 2]
        for i in range(3):  # (d x g) x b = g (d . b) - d (g . b)
            J[i] = (tg * ray_b[k, i] - gb * t[i]) / length
            J[3 + i] = normal[k, i] / length
        w = (1.0 - (e / limit) ** 2) ** 2 / (sigma_ray * sigma_ray)
        for i in range(6):
            b[i] -= w * J[i] * e
            for j in range(i + 1):
                H[i, j] += w * J[i] * J[j]
    trace = H[3, 3] + H[4, 4] + H[5, 5]
    for i in range(3):
        H[i, i] += 1.0 / (sigma_rotation * sigma_rotation)
        for j in range(i + 1):
            H[3 + i, 3 + j] += 1e3 * (trace + 1.0) * t[i] * t[j]  # its length is free
        H[3 + i, 3 + i] += 1e-6 * trace + 1e-9
    turned = matmul(R, R_believed.T.copy())  # what the prior pulls back: small, so its vector part is its logarithm
    b[0] -= 0.5 * (turned[2, 1] - turned[1, 2]) / (sigma_rotation * sigma_rotation)
    b[1] -= 0.5 * (turned[0, 2] - turned[2, 0]) / (sigma_rotation * sigma_rotation)
    b[2] -= 0.5 * (turned[1, 0] - turned[0, 1]) / (sigma_rotation * sigma_rotation)
    if not cholesky(H):
        return
    cholesky_solve(H, b)
    R[:] = matmul(so3_exp(b[:3].copy()), R)
    for i in range(3):
        t[i] += b[3 + i]
    length = math.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    for i in range(3):
        t[i] /= length
