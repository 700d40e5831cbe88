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
from lodelight.estimation.bundle_problem import BundleProblem, BundleResult, as_f64, observations_of
from lodelight.estimation.factors.pose_prior import add_pose_prior
from lodelight.estimation.factors.reprojection import TESTED_PX, TESTED_PX_DEPTH, inliers_of
from lodelight.estimation.pose import BROAD_SIGMA_M, BROAD_SIGMA_RAD
from lodelight.types import AnyArray, Array, Bools, Ints

# A step that promises less than this moves all poses together by 1e-3 of their standard deviation.
CONVERGED_CHI2 = 1e-6
DIAGONAL = (0, 2, 5)  # of a symmetric 3x3 matrix whose lower half is stored row by row
DAMPING_START, DAMPING_MIN, DAMPING_MAX = 1e-5, 1e-9, 1e6


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
    adjustment = Adjustment(problem)
    adjustment.run(iterations, robust, stop)
    if robust or polish:
        adjustment.drop_outliers()
    if polish:
        adjustment.run(polish, False, stop)
    return adjustment.result(covariance_of)


@dataclass
class Linear:
    """Normal equations at one state. W and chain_H, the largest part, are one array for both states: they are those of
    the state that was linearized last."""

    chi2: Array
    U: Array
    g_pose: Array
    V: Array
    g_point: Array
    W: Array
    cost: float = 0.0
    chain_H: Array | None = None
    chain_g: Array | None = None


@dataclass
class State:
    """rest (K, 9) : velocity and biases, where there is an IMU"""

    R: Array
    p: Array
    xyz: Array
    rest: Array | None = None


@dataclass
class Adjustment:
    """The problem sorted for the kernels, and the work in progress."""

    problem: BundleProblem
    cost: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        q, all_ = self.problem, observations_of(self.problem)
        n, k, m = len(all_.keyframe), len(q.R), len(all_.xyz)
        free = np.flatnonzero(~np.asarray(q.fixed, bool))
        node = np.full(k, -1, np.int32)
        node[free] = np.arange(len(free))
        by_point = np.argsort(all_.point, kind="stable")
        self.point_start = np.searchsorted(all_.point[by_point], np.arange(m + 1)).astype(np.int32)
        self.plan = BlockPlan.of(
            self._coupled(_couplings(node[all_.keyframe[by_point]], self.point_start, len(free)), node)
        )
        self.position = np.full(k, -1, np.int32)
        self.position[free] = self.plan.position[: len(free)]
        self.order = np.lexsort((self.position[all_.keyframe], all_.point))
        self.fixed_points = all_.fixed_points
        self.lenses = all_.lenses
        self.keyframe, self.point, self.lens = (
            a[self.order].astype(np.int32) for a in (all_.keyframe, all_.point, all_.lens)
        )
        self.px, self.sigma_px, self.inv_depth, self.sigma_inv_depth, self.weight = (
            as_f64(a[self.order]) for a in (all_.px, all_.sigma_px, all_.inv_depth, all_.sigma_inv_depth, all_.weight)
        )
        self.state, self.trial = (State(as_f64(q.R).copy(), as_f64(q.p).copy(), all_.xyz.copy()) for _ in range(2))
        W = np.empty((n, 3, 6))
        self.linear, self.trial_linear = (
            Linear(
                np.full(n, np.inf), np.empty((k, 6, 6)), np.empty((k, 6)), np.empty((m, 6)), np.empty((m, 3)), W
            )
            for _ in range(2)
        )  # fmt: skip
        self.V_inverse = np.empty((m, 6))
        self.S, self.b = np.empty((self.plan.n_blocks, 6, 6)), np.empty((len(self.plan.position), 6))
        self.active, self.worth = np.ones(n, bool), np.ones(n)

    def _coupled(self, poses: Bools, node: Ints) -> Bools:
        """Which unknowns couple: those of the poses (n, n), and whatever else there is behind them."""
        return poses

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
                    self._linearize(self.state, self.linear, robust, self.linear.chi2)
                damping = max(10.0 * damping, DAMPING_START)
                if damping > DAMPING_MAX:
                    return
            damping = max(0.1 * damping, DAMPING_MIN)
            self.state, self.trial = self.trial, self.state
            self.linear, self.trial_linear = self.trial_linear, self.linear
            self.cost.append(self.linear.cost)

    def result(self, covariance_of: AnyArray | Sequence[int]) -> BundleResult:
        n, m = len(self.problem.keyframe), len(self.problem.xyz)
        inliers, chi2 = np.empty(len(self.order), bool), np.empty(len(self.order))
        inliers[self.order], chi2[self.order] = self.inliers, self.linear.chi2
        covariance = self._covariance(np.asarray(covariance_of, np.int32))
        at = self.state
        return BundleResult(at.R, at.p, at.xyz[:m], inliers[:n], chi2[:n], self.cost, covariance, chi2[n:])

    def _linearize(self, at: State, out: Linear, robust: bool, before: Array) -> float:
        """Fill `out`; returns its cost as far as it can be compared with the state that had `before`."""
        q = self.problem
        out.cost, comparable = bundle_kernels.linearize(
            *self.lenses, self.lens, at.R, at.p, at.xyz,
            self.keyframe, self.point, self.px, self.sigma_px, self.inv_depth, self.sigma_inv_depth, self.weight,
            self.active, robust, before,
            out.chi2, out.U, out.g_pose, out.V, out.g_point, out.W,
        )  # fmt: skip
        survey = self._add_survey(at, out)
        out.cost += survey
        comparable += survey
        for prior in q.priors:
            k = prior.keyframe
            extra = add_pose_prior(
                at.R[k],
                at.p[k],
                as_f64(prior.mean.R),
                as_f64(prior.mean.t),
                as_f64(prior.information),
                out.U[k],
                out.g_pose[k],
            )
            out.cost += extra
            comparable += extra
        return comparable

    def _add_survey(self, at: State, out: Linear) -> float:
        """Hold the lights, the last of the points, to where they were surveyed; returns the cost."""
        lights = self.problem.lights
        if lights is None:
            return 0.0
        first = len(self.problem.xyz)
        information = 1.0 / as_f64(lights.sigma_m) ** 2
        off = at.xyz[first:] - lights.xyz
        out.V[first:, DIAGONAL] += information[:, None]
        out.g_point[first:] += information[:, None] * off
        return float((information * (off**2).sum(axis=1)).sum())

    def _reduce(self, damping: float) -> bool:
        self._reduce_points(damping)
        return self.plan.factor(self.S)

    def _reduce_points(self, damping: float) -> None:
        at = self.linear
        bundle_kernels.reduce(
            damping, self.keyframe, self.point_start, self.fixed_points, self.position, self.plan.slot,
            at.U, at.g_pose, at.V, at.g_point, at.W, self.V_inverse, self.S, self.b,
        )  # fmt: skip

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
