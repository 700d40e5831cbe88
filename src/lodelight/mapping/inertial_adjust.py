"""The last adjustment of a map that was flown with an IMU: all keyframes and points, and the samples between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lodelight.estimation.bundle_problem import BundleProblem, BundleResult
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.estimation.inertial_bundle import ImuChain, inertial_bundle_adjust, lengths, tied
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.mapping.local import bundle_of, commit_bundle
from lodelight.mapping.map import Map
from lodelight.mapping.tag_corners import with_tag_corners
from lodelight.types import Array, Ints

WEIGHINGS = 2  # times that the corners' noise is found from what is left of them
WEIGHED = (0.4, 3.0)  # by no more than that at a time
MIN_POINTS = 3  # that a keyframe can be located by
FREE_TILT, HELD_YAW, HELD_M = 0.1, 1e-4, 1e-4  # rad, rad, m: of the root, whose vertical the IMU knows better


def adjust_with_imu(
    map: Map, orb: OrbConfig, sigma_px: float, iterations: int, chain_of: Callable[[Ints, Array], ImuChain | None],
    metric: bool,
) -> bool:  # fmt: skip
    """Adjust the whole map; False where there is nothing to adjust it with.

    chain_of : the IMU between these keyframes (K,), whose rotations are (K, 3, 3)
    metric : depths were measured; else they come from the window, which had the same IMU, and would count it twice
    """
    with map.lock:
        window = map.alive_keyframes
        problem, keyframes, points, rows = bundle_of(map, window, orb, sigma_px)
        chain = chain_of(keyframes, problem.R)
        if chain is None:
            return False
        variance = np.trace(map.keyframes.covariance[keyframes, 3:, 3:], axis1=1, axis2=2) / 3.0
        unseen = np.bincount(problem.keyframe, minlength=len(keyframes)) < MIN_POINTS
        chain = tied(chain, unseen, problem.R, problem.p, variance)
        if not metric:
            chain = lengths(chain, problem.R, problem.p, variance)
        whole = upright_free(with_tag_corners(map, problem if metric else without_depth(problem), keyframes, window))
    result, rest = inertial_bundle_adjust(whole, chain, iterations)
    for _ in range(WEIGHINGS):
        whole = weighed(whole, result)
        result, rest = inertial_bundle_adjust(whole, replace(chain, rest=rest), iterations)
    with map.lock:
        commit_bundle(map, result.R, result.p, result.xyz[: len(points)], whole.fixed, keyframes, points)
        still = map.features.point[rows] == points[problem.point]
        map.unlink(rows[~result.inliers[: len(rows)] & still])
        map.refresh_points(points[map.points.alive[points]], orb.scale_factor, orb.n_levels)
    return True


def weighed(problem: BundleProblem, result: BundleResult) -> BundleProblem:
    """From the result on, with corners as noisy as they have shown to be.

    What is assumed of them is cautious; beside an IMU caution has a price: the less images count, the more of the
    IMU's noise becomes scale.
    """
    used = result.inliers
    unknowns = 3 * len(np.unique(problem.point[used])) + 6 * len(problem.R)
    rows = 2 * int(used.sum()) + int((problem.inv_depth[used] > 0.0).sum())
    if rows < 2 * unknowns:
        return problem
    share = float(np.clip(np.sqrt(result.chi2[used].sum() / (rows - unknowns)), *WEIGHED))
    return replace(problem, R=result.R, p=result.p, xyz=result.xyz, sigma_px=share * np.asarray(problem.sigma_px))


def upright_free(problem: BundleProblem) -> BundleProblem:
    """A fixed root becomes one that may tilt."""
    roots = np.flatnonzero(problem.fixed)
    if len(roots) != 1:  # none, or a map that was there before
        return problem
    k = int(roots[0])
    R = np.asarray(problem.R[k], np.float64)
    information = np.diag(np.array([FREE_TILT, FREE_TILT, HELD_YAW, HELD_M, HELD_M, HELD_M]) ** -2.0)
    information[:3, :3] = R.T @ information[:3, :3] @ R
    prior = PosePrior(k, SE3(R, problem.p[k]), information)
    return replace(problem, fixed=np.zeros(len(problem.fixed), bool), priors=[*problem.priors, prior])


def without_depth(problem: BundleProblem) -> BundleProblem:
    """Depths only of points that are seen once, where they say nothing of poses."""
    often = np.bincount(problem.point, minlength=len(problem.xyz))[problem.point] > 1
    return replace(problem, inv_depth=np.where(often, 0.0, problem.inv_depth))
