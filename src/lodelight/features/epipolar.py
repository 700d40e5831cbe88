"""Matches between two views whose relative pose is known: same descriptor, same epipolar plane. Any lens."""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.features.features import Features
from lodelight.features.hamming import hamming
from lodelight.features.matching import HAMMING_STRICT
from lodelight.geometry.se3 import SE3
from lodelight.types import Array, Ints, Words

EPIPOLAR_SIGMAS = 1.96  # 95 % of the corners' noise across the epipolar plane
NEAR_EPIPOLE = math.cos(math.radians(3.0))  # a ray this near the baseline cannot be triangulated


def match_epipolar(a: Features, b: Features, T_b_a: SE3, sigma_rad_b: Array, max_hamming: int = HAMMING_STRICT) -> Ints:
    """For every feature of a the one of b, mutually nearest in Hamming distance within the epipolar band, or -1.

    T_b_a : pose of camera a in camera b; sigma_rad_b : (M,) rad, noise of b's rays
    """
    baseline = float(np.linalg.norm(T_b_a.t))
    if baseline == 0.0 or len(a) == 0 or len(b) == 0:
        return np.full(len(a), -1, np.int32)
    epipole = T_b_a.t / baseline
    return _match(a.ray @ T_b_a.R.T, a.desc, b.ray, b.desc, epipole, sigma_rad_b, max_hamming)


@kernel
def _match(
    ray_a: Array, desc_a: Words, ray_b: Array, desc_b: Words, epipole: Array, sigma_rad_b: Array, max_hamming: int
) -> Ints:
    n, m = len(ray_a), len(ray_b)
    best = np.full(n, -1, np.int32)
    back = np.full(m, -1, np.int32)
    back_distance = np.full(m, max_hamming + 1, np.int32)
    bound = np.empty(m)
    for j in range(m):
        along = ray_b[j, 0] * epipole[0] + ray_b[j, 1] * epipole[1] + ray_b[j, 2] * epipole[2]
        bound[j] = -1.0 if abs(along) > NEAR_EPIPOLE else EPIPOLAR_SIGMAS * sigma_rad_b[j]
    for i in range(n):
        x = epipole[1] * ray_a[i, 2] - epipole[2] * ray_a[i, 1]
        y = epipole[2] * ray_a[i, 0] - epipole[0] * ray_a[i, 2]
        z = epipole[0] * ray_a[i, 1] - epipole[1] * ray_a[i, 0]
        norm = math.sqrt(x * x + y * y + z * z)
        if norm < 1e-6:
            continue
        x, y, z = x / norm, y / norm, z / norm
        nearest = max_hamming + 1
        for j in range(m):
            if abs(x * ray_b[j, 0] + y * ray_b[j, 1] + z * ray_b[j, 2]) > bound[j]:
                continue
            distance = hamming(desc_a[i], desc_b[j])
            if distance < nearest:
                nearest, best[i] = distance, j
            if distance < back_distance[j]:
                back_distance[j], back[j] = distance, i
    for i in range(n):
        if best[i] >= 0 and back[best[i]] != i:
            best[i] = -1
    return best
