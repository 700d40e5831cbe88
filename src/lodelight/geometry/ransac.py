"""A pose that most correspondences agree on, when many of them are wrong.

Poses are drawn from three correspondences, scored by all (a squared error counts up to its 95 % bound), and the best
one so far is refined on those that agree. Deterministic: the draws come from the seed alone.
Sources: Fischler and Bolles 1981; Torr and Zisserman, MLESAC, 2000 (the score); Chum, Matas, Kittler 2003 (refining
the best); Chum and Matas, PROSAC, 2005 (good correspondences first).
"""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import cholesky, cholesky_solve
from lodelight.geometry.p3p import p3p, triangle_pose
from lodelight.geometry.so3 import so3_perturbed
from lodelight.types import AnyArray, Array, Words

RAYS, POINTS = 0, 1  # what the camera has of a world point: its direction, or its position
BOUNDS = (5.991, 7.815)  # 95 % of a chi-square distribution with 2 and 3 degrees of freedom
REFINEMENTS = 5


@kernel
def ransac_pose(
    kind: int, seen: Array, xyz: Array, sigma: Array, by_score: bool, seed: int, confidence: float, max_iterations: int
) -> tuple[Array, Array, Array, int]:  # fmt: skip
    """R (3, 3) and c (3,) of T_world_cam, chi2 (N,), and the number of poses drawn.

    seen (N, 3) : unit rays, or points in m, camera frame; xyz (N, 3) m, world; sigma (N,) rad or m
    by_score : the rows are sorted, likely ones first
    """
    n = len(xyz)
    state = np.empty(1, np.uint64)
    state[0] = seed
    best_R, best_c, best = np.eye(3), np.zeros(3), math.inf
    R, c = np.empty((4, 3, 3)), np.empty((4, 3))
    sample, from_cam, from_world = np.empty(3, np.int64), np.empty((3, 3)), np.empty((3, 3))
    # PROSAC: draw among the first `pool` rows, which grows as if max_iterations draws were to be had from all
    pool, switch = (3 if by_score else n), 1.0
    draws = float(max_iterations)
    for i in range(3):
        draws *= (pool - i) / (n - i)
    drawn, needed = 0, max_iterations
    while drawn < needed:
        drawn += 1
        if drawn > switch and pool < n:
            more = draws * (pool + 1) / (pool - 2)
            switch += math.ceil(more - draws)
            draws, pool = more, pool + 1
        _draw(state, pool, by_score and drawn <= switch, sample)
        for i in range(3):
            for a in range(3):
                from_cam[i, a], from_world[i, a] = seen[sample[i], a], xyz[sample[i], a]
        if kind == RAYS:
            count = p3p(from_cam, from_world, R, c)
        else:
            count = triangle_pose(from_cam, from_world, R[0], c[0])
        for k in range(count):
            score, _ = _score(kind, R[k], c[k], seen, xyz, sigma, best)
            if score >= best:
                continue
            best_R, best_c, best = R[k].copy(), c[k].copy(), score
            fine_R, fine_c = _refine(kind, best_R, best_c, seen, xyz, sigma)
            score, inliers = _score(kind, fine_R, fine_c, seen, xyz, sigma, math.inf)
            if score < best:
                best_R, best_c, best = fine_R, fine_c, score
            all_good = (inliers / n) ** 3
            if all_good > 0.0:
                enough = math.log(1.0 - confidence) / math.log(1.0 - min(all_good, 1.0 - 1e-12))
                needed = min(needed, 1 + int(enough))
    chi2 = np.empty(n)
    for i in range(n):
        chi2[i] = _error(kind, best_R, best_c, seen, xyz, sigma, i) if best < math.inf else math.inf
    return best_R, best_c, chi2, drawn


@kernel
def _draw(state: Words, pool: int, with_last: bool, sample: AnyArray) -> None:
    """Three different rows below `pool`, its last one among them if asked for."""
    for i in range(3):
        again = True
        while again:
            sample[i] = pool - 1 if with_last and i == 0 else int(_uniform(state) * pool)
            again = False
            for j in range(i):
                again = again or sample[j] == sample[i]


@kernel
def _uniform(state: Words) -> float:
    """In [0, 1); splitmix64 (Steele, Lea, Flood 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel
def _error(kind: int, R: Array, c: Array, seen: Array, xyz: Array, sigma: Array, i: int) -> float:
    """Squared error over sigma: of the ray's angle (2 dof; inf beyond a right angle), or of the position (3 dof)."""
    dx, dy, dz = xyz[i, 0] - c[0], xyz[i, 1] - c[1], xyz[i, 2] - c[2]
    x = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
    y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
    z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    fx, fy, fz = seen[i, 0], seen[i, 1], seen[i, 2]
    if kind == POINTS:
        return float(((x - fx) ** 2 + (y - fy) ** 2 + (z - fz) ** 2) / (sigma[i] * sigma[i]))
    if x * fx + y * fy + z * fz <= 0.0:
        return math.inf
    ex, ey, ez = fy * z - fz * y, fz * x - fx * z, fx * y - fy * x
    return float((ex * ex + ey * ey + ez * ez) / ((x * x + y * y + z * z) * sigma[i] * sigma[i]))


@kernel
def _score(
    kind: int, R: Array, c: Array, seen: Array, xyz: Array, sigma: Array, stop_at: float
) -> tuple[float, int]:  # fmt: skip
    """Sum of errors, each up to its bound, and the number within it; given up once the sum reaches `stop_at`."""
    bound = BOUNDS[kind]
    total, inliers = 0.0, 0
    for i in range(len(xyz)):
        e = _error(kind, R, c, seen, xyz, sigma, i)
        if e < bound:
            total += e
            inliers += 1
        else:
            total += bound
            if total >= stop_at:
                break
    return total, inliers


@kernel
def _refine(kind: int, R: Array, c: Array, seen: Array, xyz: Array, sigma: Array) -> tuple[Array, Array]:
    """Gauss-Newton on the correspondences that agree, chosen anew before every step."""
    H, g = np.empty((6, 6)), np.empty(6)
    M, J, e = np.empty((3, 3)), np.empty((3, 6)), np.empty(3)
    for _ in range(REFINEMENTS):
        H[:] = 0.0
        g[:] = 0.0
        for i in range(len(xyz)):
            if _error(kind, R, c, seen, xyz, sigma, i) >= BOUNDS[kind]:
                continue
            dx, dy, dz = xyz[i, 0] - c[0], xyz[i, 1] - c[1], xyz[i, 2] - c[2]
            x = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
            y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
            z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
            fx, fy, fz = seen[i, 0], seen[i, 1], seen[i, 2]
            s = 1.0 / sigma[i]
            if kind == POINTS:  # e = (X_cam - seen) / sigma, M = de / dX_cam
                e[0], e[1], e[2] = s * (x - fx), s * (y - fy), s * (z - fz)
                M[:] = 0.0
                M[0, 0] = M[1, 1] = M[2, 2] = s
            else:  # e = ray x X_cam / (|X_cam| sigma); its change with |X_cam| is of second order and left out
                s /= math.sqrt(x * x + y * y + z * z)
                e[0], e[1], e[2] = s * (fy * z - fz * y), s * (fz * x - fx * z), s * (fx * y - fy * x)
                M[0, 0] = M[1, 1] = M[2, 2] = 0.0
                M[0, 1], M[0, 2], M[1, 2] = -s * fz, s * fy, -s * fx
                M[1, 0], M[2, 0], M[2, 1] = s * fz, -s * fy, s * fx
            for a in range(3):
                J[a, 0] = M[a, 1] * z - M[a, 2] * y
                J[a, 1] = M[a, 2] * x - M[a, 0] * z
                J[a, 2] = M[a, 0] * y - M[a, 1] * x
                for b in range(3):
                    J[a, 3 + b] = -(M[a, 0] * R[b, 0] + M[a, 1] * R[b, 1] + M[a, 2] * R[b, 2])
            for a in range(6):
                for k in range(3):
                    g[a] -= J[k, a] * e[k]
                    for b in range(a + 1):
                        H[a, b] += J[k, a] * J[k, b]
        for a in range(6):
            H[a, a] *= 1.0 + 1e-9
        if not cholesky(H):
            break
        cholesky_solve(H, g)
        R, c = so3_perturbed(R, g[:3]), c + g[3:]
    return R, c
