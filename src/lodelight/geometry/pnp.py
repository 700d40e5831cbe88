"""Where a camera is, from matches with known points of which many may be wrong."""

from __future__ import annotations

import numpy as np

from lodelight.geometry.ransac import BOUNDS, POINTS, RAYS, ransac_pose
from lodelight.geometry.se3 import SE3
from lodelight.types import AnyArray, Bools

MIN_AGREEING = 4  # one more than any three correspondences have by construction


def ransac_pnp(
    rays: AnyArray,
    xyz: AnyArray,
    sigma_ray_rad: AnyArray,
    seed: int = 0,
    confidence: float = 0.999,
    max_iterations: int = 2000,
    scores: AnyArray | None = None,
) -> tuple[SE3, Bools] | None:
    """T_world_cam and which matches agree with it (95 % of the true ones); None where fewer than four do.

    rays : (N, 3) unit vectors in the camera frame, of any lens; xyz : (N, 3) m, world
    sigma_ray_rad : (N,) noise of a ray about each axis across it
    confidence : probability that three true matches have been drawn when it stops
    scores : (N,) larger = more likely to be true; these are drawn first
    Chance makes a few wrong matches agree: judge the number of agreeing ones against N.
    """
    return _ransac(RAYS, rays, xyz, sigma_ray_rad, seed, confidence, max_iterations, scores)


def ransac_absolute_orientation(
    xyz_a: AnyArray,
    xyz_b: AnyArray,
    sigma_m: AnyArray,
    seed: int = 0,
    confidence: float = 0.999,
    max_iterations: int = 2000,
    scores: AnyArray | None = None,
) -> tuple[SE3, Bools] | None:
    """T_a_b between matched points (N, 3) m of two frames, and which matches agree; None where fewer than four do.

    sigma_m : (N,) noise of xyz_a - T_a_b xyz_b in each axis; the rest as in `ransac_pnp`
    """
    return _ransac(POINTS, xyz_b, xyz_a, sigma_m, seed, confidence, max_iterations, scores)


def _ransac(
    kind: int,
    seen: AnyArray,
    xyz: AnyArray,
    sigma: AnyArray,
    seed: int,
    confidence: float,
    max_iterations: int,
    scores: AnyArray | None,
) -> tuple[SE3, Bools] | None:
    n = len(xyz)
    if n < MIN_AGREEING:
        return None
    order = np.arange(n) if scores is None else np.argsort(-np.asarray(scores), kind="stable")
    seen, xyz, sigma = (np.ascontiguousarray(a[order], np.float64) for a in (seen, xyz, sigma))
    R, c, chi2, _ = ransac_pose(kind, seen, xyz, sigma, scores is not None, seed, confidence, max_iterations)
    agrees = np.zeros(n, bool)
    agrees[order] = chi2 < BOUNDS[kind]
    return (SE3(R, c), agrees) if np.count_nonzero(agrees) >= MIN_AGREEING else None
