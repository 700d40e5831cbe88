"""One pose against points that are held fixed: the estimate of every frame.

Levenberg-Marquardt on the reprojection factor in rounds. The first rounds carry Cauchy's kernel; after each, every
observation is tested again at the 95 % bound, so that one taken for an outlier can return; the last rounds run on the
inliers alone, without kernel, where the estimate is efficient and its covariance the inverse of the information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.factors.pose_prior import add_pose_prior
from lodelight.estimation.factors.reprojection import (
    CHI2_PX,
    CHI2_PX_DEPTH,
    TESTED_PX,
    TESTED_PX_DEPTH,
    inliers_of,
    reprojection,
)
from lodelight.estimation.robust import cauchy
from lodelight.geometry.cameras import Camera
from lodelight.geometry.dense import cholesky, cholesky_solve, matmul, spd_inverse
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import matrix_from_quat_wxyz, quat_wxyz_from_matrix, so3_exp
from lodelight.types import AnyArray, Array, Bools

ROUNDS = 4
ROBUST_ROUNDS = 2
ITERATIONS = 10
# A round ends where the next step promises less gain in chi-square: it would move the pose by the root of that, in its
# own standard deviations. A robust round has found its inliers at 0.1; the last rounds go on to 1e-5.
SETTLED_CHI2 = 1e-2
CONVERGED_CHI2 = 1e-10
# What is known of a pose indoors when nothing is measured: it keeps a covariance finite where points do not.
BROAD_SIGMA_RAD = math.pi
BROAD_SIGMA_M = 1000.0


@dataclass(frozen=True, eq=False)
class PoseResult:
    """covariance : (6, 6), chart of SE3.perturbed; inverse information of the inliers, less what their test costs
        (see `factors.reprojection`), times max(1, chi2 / dof)
    inliers : (N,) inside the 95 % bound; chi2 : (N,) unweighted, inf where the camera cannot see the point
    """

    T_world_body: SE3
    covariance: Array
    inliers: Bools
    chi2: Array

    @property
    def n_inliers(self) -> int:
        return int(np.count_nonzero(self.inliers))


def optimize_pose(
    T_world_body: SE3,
    T_body_cam: SE3,
    camera: Camera,
    xyz: AnyArray,
    px: AnyArray,
    sigma_px: AnyArray,
    inv_depth: AnyArray,
    sigma_inv_depth: AnyArray,
    information_weight: AnyArray | None = None,
    prior: tuple[SE3, Array] | None = None,
) -> PoseResult:
    """Most likely T_world_body given points of the world seen by camera 0.

    T_world_body : where to start
    xyz (N, 3) m, world; px (N, 2) raw pixels; sigma_px (N,)
    inv_depth, sigma_inv_depth (N,) 1/m along the camera's z; inv_depth 0 = not measured
    information_weight (N,) : scales what an observation says, not its test as an outlier; default 1
    prior : a mean and its information (6, 6) in the chart of SE3.perturbed
    Never raises on too few or degenerate observations: the covariance grows instead, up to pi rad and 1 km.
    """
    n = len(xyz)
    mean, information = prior if prior is not None else (T_world_body, np.zeros((6, 6)))
    weight = np.ones(n) if information_weight is None else _f64(information_weight)
    R, p, chi2, inliers, covariance = _optimize(
        (camera.model, camera.params, _f64(T_body_cam.R), _f64(T_body_cam.t)),
        (_f64(xyz), _f64(px), _f64(sigma_px), _f64(inv_depth), _f64(sigma_inv_depth)), weight,
        (_f64(mean.R), _f64(mean.t), _f64(information)), prior is not None, _f64(T_world_body.R), _f64(T_world_body.t),
    )  # fmt: skip
    # Back onto SO(3): a motion model that inverts by transposing would more than double what rounding left, each frame.
    R = matrix_from_quat_wxyz(quat_wxyz_from_matrix(R))
    return PoseResult(SE3(R, p), covariance, inliers, chi2)


def _f64(a: AnyArray) -> Array:
    return np.ascontiguousarray(a, dtype=np.float64)


Lens: TypeAlias = tuple[int, Array, Array, Array]  # model, params, R_body_cam, p_body_cam
Views: TypeAlias = tuple[Array, Array, Array, Array, Array]  # xyz, px, sigma_px, inv_depth, sigma_inv_depth
Prior: TypeAlias = tuple[Array, Array, Array]  # R, p, information


@kernel
def _linearize(
    lens: Lens, views: Views, weight: Array, active: Bools, robust: bool, R: Array, p: Array,
    before: Array, chi2: Array, H: Array, g: Array,
) -> tuple[float, float]:  # fmt: skip
    """Fill chi2 (N,), H (6, 6) lower half and g (6,); returns the cost, and the cost comparable with `before`.

    Comparable: over the observations seen in `before`; one that left the view keeps the cost it had there, so a
    step is neither rewarded for losing points nor stopped by one.
    """
    model, params, R_body_cam, p_body_cam = lens
    xyz, px, sigma_px, inv_depth, sigma_inv_depth = views
    E = np.zeros((2, 3))
    H[:] = 0.0
    g[:] = 0.0
    cost = comparable = 0.0
    for i in range(xyz.shape[0]):
        rows, r, Ju, Jv, Jd = reprojection(
            model, params, R, p, R_body_cam, p_body_cam, xyz[i, 0], xyz[i, 1], xyz[i, 2], px[i, 0], px[i, 1],
            sigma_px[i], inv_depth[i], sigma_inv_depth[i], E,
        )  # fmt: skip
        bound = math.inf if not robust else CHI2_PX_DEPTH if inv_depth[i] > 0.0 else CHI2_PX
        if rows == 0:
            chi2[i] = math.inf
            if active[i] and before[i] < math.inf:
                comparable += weight[i] * cauchy(before[i], bound)[0]
            continue
        chi2[i] = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        if not active[i]:
            continue
        value, w = cauchy(chi2[i], bound)
        cost += weight[i] * value
        if before[i] < math.inf:
            comparable += weight[i] * value
        w *= weight[i]
        for a in range(6):
            ju, jv, jd = w * Ju[a], w * Jv[a], w * Jd[a]
            g[a] += ju * r[0] + jv * r[1] + jd * r[2]
            for b in range(a + 1):
                H[a, b] += ju * Ju[b] + jv * Jv[b] + jd * Jd[b]
    for a in range(3, 6):  # dr/dp = -dr/dX
        g[a] = -g[a]
        for b in range(3):
            H[a, b] = -H[a, b]
    return cost, comparable


@kernel
def _optimize(
    lens: Lens, views: Views, weight: Array, prior: Prior, has_prior: bool, R: Array, p: Array
) -> tuple[Array, Array, Array, Bools, Array]:  # fmt: skip
    """From R and p to the optimum: R, p, chi2 (N,), inliers (N,), covariance (6, 6)."""
    n = len(weight)
    chi2, trial_chi2 = np.full(n, math.inf), np.empty(n)
    H, g, trial_H, trial_g = np.empty((6, 6)), np.empty(6), np.empty((6, 6)), np.empty(6)
    active = np.ones(n, np.bool_)
    for round_ in range(ROUNDS):
        robust, damping = round_ < ROBUST_ROUNDS, 1e-9
        cost, _ = _linearize(lens, views, weight, active, robust, R, p, chi2, chi2, H, g)
        if has_prior:
            cost += add_pose_prior(R, p, prior[0], prior[1], prior[2], H, g)
        for _ in range(ITERATIONS):
            L, step = H.copy(), -g
            for a in range(6):
                L[a, a] += damping * H[a, a] + 1e-12
            if cholesky(L):
                cholesky_solve(L, step)
                gain = 0.0
                for a in range(6):
                    gain -= g[a] * step[a]
                if gain < (SETTLED_CHI2 if robust else CONVERGED_CHI2):
                    break
                trial_R, trial_p = matmul(R, so3_exp(step[:3])), p + step[3:]
                trial_cost, comparable = _linearize(
                    lens, views, weight, active, robust, trial_R, trial_p, chi2, trial_chi2, trial_H, trial_g
                )
                if has_prior:
                    extra = add_pose_prior(trial_R, trial_p, prior[0], prior[1], prior[2], trial_H, trial_g)
                    trial_cost, comparable = trial_cost + extra, comparable + extra
                if comparable <= cost:
                    R, p, cost, damping = trial_R, trial_p, trial_cost, max(0.1 * damping, 1e-9)
                    H, trial_H, g, trial_g, chi2, trial_chi2 = trial_H, H, trial_g, g, trial_chi2, chi2
                    continue
            damping = max(100.0 * damping, 1e-6)
        inliers = inliers_of(chi2, views[3])
        settled = not robust
        for i in range(n):
            settled = settled and inliers[i] == active[i]
        active = inliers
        if settled:
            break
    widen = _tested(views[3], active, chi2, weight, has_prior, trial_chi2)
    _linearize(lens, views, trial_chi2, active, False, R, p, chi2, chi2, H, g)
    if has_prior:
        add_pose_prior(R, p, prior[0], prior[1], prior[2], H, g)
    return R, p, chi2, active, _covariance(H, widen)


@kernel
def _tested(inv_depth: Array, inliers: Bools, chi2: Array, weight: Array, has_prior: bool, worth: Array) -> float:
    """Fill worth (N,), the weight that is left of each observation after its test; returns max(1, chi2 / dof)."""
    rows, total, expected = 0, 0.0, 0.0
    for i in range(len(weight)):
        k, share = (3, TESTED_PX_DEPTH) if inv_depth[i] > 0.0 else (2, TESTED_PX)
        worth[i] = share * weight[i]
        if inliers[i]:
            rows += k
            total += chi2[i]
            expected += share * k
    dof = rows if has_prior else rows - 6
    return max(1.0, total / expected * rows / dof) if dof > 0 else 1.0


@kernel
def _covariance(H: Array, widen: float) -> Array:
    """Inverse information, finite where it is singular."""
    information = H / widen
    for a in range(6):
        information[a, a] += 1.0 / (BROAD_SIGMA_RAD**2 if a < 3 else BROAD_SIGMA_M**2)
    covariance, proper = spd_inverse(information)
    if not proper:  # rounding of a singular H: nothing is known
        covariance[:] = 0.0
        for a in range(6):
            covariance[a, a] = BROAD_SIGMA_RAD**2 if a < 3 else BROAD_SIGMA_M**2
    return covariance
