"""Bundle adjustment: poses and points together, from a window of keyframes to the whole map.

Levenberg-Marquardt on the reprojection factor. Points are eliminated one by one (Schur complement), the system of
poses that remains is factored by blocks. Derivation: docs/derivations-reprojection.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation import bundle_kernels
from lodelight.estimation.block_cholesky import BlockPlan
from lodelight.estimation.factors.pose_prior import PosePrior, add_pose_prior
from lodelight.estimation.factors.reprojection import TESTED_PX, TESTED_PX_DEPTH, inliers_of
from lodelight.estimation.pose import BROAD_SIGMA_M, BROAD_SIGMA_RAD
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.types import AnyArray, Array, Bools, Ints

# A step that promises less than this moves all poses together by 1e-3 of their standard deviation.
CONVERGED_CHI2 = 1e-6
DAMPING_START, DAMPING_MIN, DAMPING_MAX = 1e-5, 1e-9, 1e6


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """K poses, M points, N observations of one camera; nothing here is written to.

    R (K, 3, 3), p (K, 3) m : T_world_body; fixed (K,) : poses that are not moved
    xyz (M, 3) m, world; fixed_points (M,) : points that are not moved (surveyed corners); default none
    keyframe, point (N,) : who sees what; px (N, 2), sigma_px (N,) raw pixels
    inv_depth, sigma_inv_depth (N,) 1/m along the camera's z, inv_depth 0 = not measured
    weight (N,) : scales what an observation says, not its test as an outlier; default 1

    Without a fixed pose or a prior the result floats: damping holds it near its start.
    """

    camera: Camera
    T_body_cam: SE3
    R: AnyArray
    p: AnyArray
    fixed: AnyArray
    xyz: AnyArray
    keyframe: AnyArray
    point: AnyArray
    px: AnyArray
    sigma_px: AnyArray
    inv_depth: AnyArray
    sigma_inv_depth: AnyArray
    weight: AnyArray | None = None
    fixed_points: AnyArray | None = None
    priors: Sequence[PosePrior] = ()


@dataclass(frozen=True, eq=False)
class BundleResult:
    """R, p, xyz : as in the problem, adjusted
    inliers, chi2 : (N,) in the problem's order, at the result; chi2 is unweighted, inf where not seen
    cost : after each iteration, the start first; it may rise where the kernel is taken off or outliers leave
    covariance : (len(covariance_of), 6, 6), chart of SE3.perturbed; zero for a fixed pose
    """

    R: Array
    p: Array
    xyz: Array
    inliers: Bools
    chi2: Array
    cost: list[float]
    covariance: Array


def bundle_adjust(
    problem: BundleProblem,
    iterations: int = 10,
    robust: bool = True,
    polish: int = 0,
    stop: Callable[[], bool] | None = None,
    covariance_of: AnyArray | Sequence[int] = (),
) -> BundleResult:
    """Most likely poses and points.

    iterations : at most so many with all observations, under Cauchy's kernel if `robust`
    polish : then so many without kernel on the inliers alone (the two stages of local adjustment: 5 and 10)
    stop : asked between iterations; the best state so far is returned
    covariance_of : keyframes whose marginal covariance is wanted, with all points uncertain; it counts what the last
        stage counted, or after a robust one the inliers, less what their test costs (see `factors.reprojection`)
    """
    adjustment = _Adjustment(problem)
    adjustment.run(iterations, robust, stop)
    if robust or polish:
        adjustment.drop_outliers()
    if polish:
        adjustment.run(polish, False, stop)
    return adjustment.result(covariance_of)


@dataclass
class _Linear:
    """Normal equations at one state."""

    chi2: Array
    U: Array
    g_pose: Array
    V: Array
    g_point: Array
    W: Array
    cost: float = 0.0


@dataclass
class _State:
    R: Array
    p: Array
    xyz: Array


@dataclass
class _Adjustment:
    """The problem sorted for the kernels, and the work in progress."""

    problem: BundleProblem
    cost: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        q = self.problem
        n, k, m = len(q.keyframe), len(q.R), len(q.xyz)
        free = np.flatnonzero(~np.asarray(q.fixed, bool))
        node = np.full(k, -1, np.int32)
        node[free] = np.arange(len(free))
        by_point = np.argsort(q.point, kind="stable")
        self.point_start = np.searchsorted(q.point[by_point], np.arange(m + 1)).astype(np.int32)
        self.plan = BlockPlan.of(_couplings(node[q.keyframe[by_point]], self.point_start, len(free)))
        self.position = np.full(k, -1, np.int32)
        self.position[free] = self.plan.position
        self.order = np.lexsort((self.position[q.keyframe], q.point))
        weight = np.ones(n) if q.weight is None else q.weight
        fixed_points = np.zeros(m, bool) if q.fixed_points is None else q.fixed_points
        self.fixed_points = np.ascontiguousarray(fixed_points, bool)
        self.keyframe = q.keyframe[self.order].astype(np.int32)
        self.point = q.point[self.order].astype(np.int32)
        self.px, self.sigma_px, self.inv_depth, self.sigma_inv_depth, self.weight = (
            _f64(a[self.order]) for a in (q.px, q.sigma_px, q.inv_depth, q.sigma_inv_depth, weight)
        )
        self.state, self.trial = (_State(_f64(q.R).copy(), _f64(q.p).copy(), _f64(q.xyz).copy()) for _ in range(2))
        self.linear, self.trial_linear = (
            _Linear(
                np.full(n, np.inf), np.empty((k, 6, 6)), np.empty((k, 6)), np.empty((m, 6)), np.empty((m, 3)),
                np.empty((n, 3, 6)),
            )
            for _ in range(2)
        )  # fmt: skip
        self.V_inverse = np.empty((m, 6))
        self.S, self.b = np.empty((self.plan.n_blocks, 6, 6)), np.empty((len(free), 6))
        self.active, self.worth = np.ones(n, bool), np.ones(n)

    @property
    def inliers(self) -> Bools:
        return inliers_of(self.linear.chi2, self.inv_depth)

    def drop_outliers(self) -> None:
        self.active = self.inliers
        self.worth = np.where(self.inv_depth > 0.0, TESTED_PX_DEPTH, TESTED_PX)

    def run(self, iterations: int, robust: bool, stop: Callable[[], bool] | None) -> None:
        self._linearize(self.state, self.linear, robust, self.linear.chi2)
        self.cost.append(self.linear.cost)
        damping = DAMPING_START
        for _ in range(iterations):
            if stop is not None and stop():
                return
            while True:  # until a step goes downhill
                gain = self._step(damping)
                if gain is not None:
                    if gain < CONVERGED_CHI2:
                        return
                    if self._linearize(self.trial, self.trial_linear, robust, self.linear.chi2) <= self.linear.cost:
                        break
                damping = max(10.0 * damping, DAMPING_START)
                if damping > DAMPING_MAX:
                    return
            damping = max(0.1 * damping, DAMPING_MIN)
            self.state, self.trial = self.trial, self.state
            self.linear, self.trial_linear = self.trial_linear, self.linear
            self.cost.append(self.linear.cost)

    def result(self, covariance_of: AnyArray | Sequence[int]) -> BundleResult:
        n = len(self.order)
        inliers, chi2 = np.empty(n, bool), np.empty(n)
        inliers[self.order], chi2[self.order] = self.inliers, self.linear.chi2
        covariance = self._covariance(np.asarray(covariance_of, np.int32))
        return BundleResult(self.state.R, self.state.p, self.state.xyz, inliers, chi2, self.cost, covariance)

    def _linearize(self, at: _State, out: _Linear, robust: bool, before: Array) -> float:
        """Fill `out`; returns its cost as far as it can be compared with the state that had `before`."""
        q = self.problem
        out.cost, comparable = bundle_kernels.linearize(
            q.camera.model, q.camera.params, _f64(q.T_body_cam.R), _f64(q.T_body_cam.t), at.R, at.p, at.xyz,
            self.keyframe, self.point, self.px, self.sigma_px, self.inv_depth, self.sigma_inv_depth, self.weight,
            self.active, robust, before,
            out.chi2, out.U, out.g_pose, out.V, out.g_point, out.W,
        )  # fmt: skip
        for prior in q.priors:
            k = prior.keyframe
            extra = add_pose_prior(
                at.R[k],
                at.p[k],
                _f64(prior.mean.R),
                _f64(prior.mean.t),
                _f64(prior.information),
                out.U[k],
                out.g_pose[k],
            )
            out.cost += extra
            comparable += extra
        return comparable

    def _reduce(self, damping: float) -> bool:
        at = self.linear
        bundle_kernels.reduce(
            damping, self.keyframe, self.point_start, self.fixed_points, self.position, self.plan.slot,
            at.U, at.g_pose, at.V, at.g_point, at.W, self.V_inverse, self.S, self.b,
        )  # fmt: skip
        return self.plan.factor(self.S)

    def _step(self, damping: float) -> float | None:
        """Fill the trial state; returns the gain it promises, None where the damped system is not definite."""
        if not self._reduce(damping):
            return None
        self.plan.solve(self.S, self.b)
        s, to, at = self.state, self.trial, self.linear
        return bundle_kernels.step(
            self.keyframe, self.point_start, self.position, s.R, s.p, s.xyz, self.V_inverse,
            at.g_pose, at.g_point, at.W, self.b, to.R, to.p, to.xyz,
        )  # fmt: skip

    def _covariance(self, keyframes: Ints) -> Array:
        out = np.zeros((len(keyframes), 6, 6))
        wanted = np.flatnonzero(self.position[keyframes] >= 0)
        if len(wanted) == 0:
            return out
        self.weight = self.weight * self.worth
        self._linearize(self.state, self.linear, False, self.linear.chi2)
        broad = 1.0 / np.repeat([BROAD_SIGMA_RAD**2, BROAD_SIGMA_M**2], 3)
        self.linear.U[:, range(6), range(6)] += broad
        if not self._reduce(DAMPING_MIN):
            out[wanted] = np.diag(1.0 / broad)
            return out
        for i in wanted:
            position = self.position[keyframes[i]]
            for a in range(6):
                self.b[:] = 0.0
                self.b[position, a] = 1.0
                self.plan.solve(self.S, self.b)
                out[i, :, a] = self.b[position]
        symmetric: Array = 0.5 * (out + out.transpose(0, 2, 1))
        return symmetric


def _f64(a: AnyArray) -> Array:
    return np.ascontiguousarray(a, dtype=np.float64)


@kernel
def _couplings(node: Ints, point_start: Ints, n: int) -> Bools:
    """(n, n) which free keyframes see a common point; node (N,) of each observation by point, -1 = fixed."""
    out = np.zeros((n, n), np.bool_)
    for m in range(len(point_start) - 1):
        for i in range(point_start[m], point_start[m + 1]):
            if node[i] >= 0:
                for j in range(point_start[m], i):
                    if node[j] >= 0:
                        out[node[i], node[j]] = out[node[j], node[i]] = True
    return out
