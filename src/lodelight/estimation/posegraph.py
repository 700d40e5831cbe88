"""Poses against each other: what a closed loop does to a whole map.

Levenberg-Marquardt on relative poses, with the block-sparse Cholesky of bundle adjustment. Where gravity is known
(an IMU, a level world) roll and pitch do not drift and stay as they are: 4 degrees of freedom, yaw and position.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.block_cholesky import BlockPlan
from lodelight.estimation.factors.pose_prior import PosePrior, add_pose_prior
from lodelight.estimation.factors.relative_pose import relative_pose
from lodelight.estimation.robust import dynamic_covariance, huber
from lodelight.geometry.dense import matmul, transposed
from lodelight.geometry.so3 import so3_perturbed
from lodelight.types import AnyArray, Array, Bools, Ints

Robust: TypeAlias = Literal["none", "huber", "dcs"]
KERNELS = {"none": 0, "huber": 1, "dcs": 2}
CHI2_EDGE = 12.592  # 95 % of a chi-square distribution with 6 degrees of freedom
CONVERGED_CHI2 = 1e-6
DAMPING_START, DAMPING_MIN, DAMPING_MAX = 1e-6, 1e-12, 1e6
UNMEASURED = 1e-9  # on the diagonal of every pose: one that nothing holds stays where it is


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """K poses and E measured relative poses; nothing here is written to.

    R (K, 3, 3), p (K, 3) m : T_world_body, where to start; fixed (K,) : poses that are not moved
    a, b (E,) : which poses an edge joins; R_ab (E, 3, 3), p_ab (E, 3) m : the measured T_a_b
    information : (E, 6, 6), chart of SE3.perturbed of T_a_b: rotation first, position in a's axes
    doubtful : (E,) edges under the robust kernel, such as loops; default all
    priors : poses known from anchors
    """

    R: AnyArray
    p: AnyArray
    fixed: AnyArray
    a: AnyArray
    b: AnyArray
    R_ab: AnyArray
    p_ab: AnyArray
    information: AnyArray
    doubtful: AnyArray | None = None
    priors: Sequence[PosePrior] = ()


@dataclass(frozen=True, eq=False)
class PoseGraphResult:
    """chi2 : (E,) of each edge at the result; cost : after each iteration, the start first."""

    R: Array
    p: Array
    chi2: Array
    cost: list[float]


def optimize_pose_graph(
    graph: PoseGraph,
    iterations: int = 30,
    robust: Robust = "none",
    gravity_aligned: bool = False,
    stop: Callable[[], bool] | None = None,
) -> PoseGraphResult:
    """Most likely poses.

    robust : "huber" bounds the pull of a doubtful edge, "dcs" lets go of it (wrong loops)
    gravity_aligned : move yaw about the world's z axis and position only
    """
    K, E = len(graph.R), len(graph.a)
    a, b = (np.ascontiguousarray(i, np.int32) for i in (graph.a, graph.b))
    free = np.flatnonzero(~np.asarray(graph.fixed, bool))
    node = np.full(K, -1, np.int32)
    node[free] = np.arange(len(free))
    coupled = np.zeros((len(free), len(free)), bool)
    both = (node[a] >= 0) & (node[b] >= 0)
    coupled[node[a[both]], node[b[both]]] = coupled[node[b[both]], node[a[both]]] = True
    plan = BlockPlan.of(coupled)
    position = np.full(K, -1, np.int32)
    position[free] = plan.position
    doubtful = np.ones(E, bool) if graph.doubtful is None else np.ascontiguousarray(graph.doubtful, bool)
    R_ab, p_ab, information = (np.ascontiguousarray(x, np.float64) for x in (graph.R_ab, graph.p_ab, graph.information))
    known = np.array([prior.keyframe for prior in graph.priors], np.int32)
    R_mean = np.array([prior.mean.R for prior in graph.priors]).reshape(-1, 3, 3)
    p_mean = np.array([prior.mean.t for prior in graph.priors]).reshape(-1, 3)
    prior_information = np.array([prior.information for prior in graph.priors], np.float64).reshape(-1, 6, 6)

    def linearize(R: Array, p: Array) -> tuple[float, Array, Array, Array]:
        H, g, chi2 = np.empty((plan.n_blocks, 6, 6)), np.empty((len(free), 6)), np.empty(E)
        cost = _linearize(
            R, p, a, b, R_ab, p_ab, information, doubtful, KERNELS[robust], gravity_aligned,
            position, plan.slot, H, g, chi2,
        )  # fmt: skip
        cost += _add_priors(
            R, p, known, R_mean, p_mean, prior_information, gravity_aligned, position, plan.slot, H, g
        )  # fmt: skip
        return cost, H, g, chi2

    R, p = np.array(graph.R, np.float64), np.array(graph.p, np.float64)
    cost, H, g, chi2 = linearize(R, p)
    history, damping = [cost], DAMPING_START
    diagonal = plan.slot[np.arange(len(free)), np.arange(len(free))]
    axes = np.arange(6)
    while len(history) <= iterations and damping <= DAMPING_MAX and not (stop is not None and stop()):
        S, step = H.copy(), -g
        S[diagonal[:, None], axes, axes] *= 1.0 + damping
        if plan.factor(S):
            plan.solve(S, step)
            if -np.sum(g * step) < CONVERGED_CHI2:
                break
            trial_R, trial_p = _moved(R, p, position, step, gravity_aligned)
            trial = linearize(trial_R, trial_p)
            if trial[0] <= cost:
                R, p, (cost, H, g, chi2) = trial_R, trial_p, trial
                history.append(cost)
                damping = max(0.1 * damping, DAMPING_MIN)
                continue
        damping *= 10.0
    return PoseGraphResult(R, p, chi2, history)


@kernel
def _linearize(
    R: Array, p: Array, edge_a: Ints, edge_b: Ints, R_ab: Array, p_ab: Array, information: Array, doubtful: Bools,
    robust: int, gravity_aligned: bool, position: Ints, slot: Ints, H: Array, g: Array, chi2: Array,
) -> float:  # fmt: skip
    """Fill the normal equations (H by blocks, upper half) and chi2 (E,); returns the cost."""
    H[:] = 0.0
    g[:] = 0.0
    r, J = np.empty(6), np.empty((2, 6, 6))
    for i in range(g.shape[0]):
        for x in range(6):
            H[slot[i, i], x, x] = UNMEASURED
    cost = 0.0
    for e in range(len(edge_a)):
        a, b = edge_a[e], edge_b[e]
        relative_pose(R[a], p[a], R[b], p[b], R_ab[e], p_ab[e], r, J[0], J[1])
        if gravity_aligned:
            _keep_yaw(J[0], R[a])
            _keep_yaw(J[1], R[b])
        chi2[e] = 0.0
        for x in range(6):
            for y in range(6):
                chi2[e] += r[x] * information[e, x, y] * r[y]
        value, w = chi2[e], 1.0
        if doubtful[e] and robust == 1:
            value, w = huber(chi2[e], CHI2_EDGE)
        elif doubtful[e] and robust == 2:
            value, w = dynamic_covariance(chi2[e], CHI2_EDGE)
        cost += value
        at = (position[a], position[b])
        for s in range(2):
            if at[s] < 0:
                continue
            weighted = np.zeros((6, 6))  # w J_s^T information
            for x in range(6):
                for y in range(6):
                    f = w * J[s, y, x]
                    if f != 0.0:
                        for z in range(6):
                            weighted[x, z] += f * information[e, y, z]
            for x in range(6):
                for y in range(6):
                    g[at[s], x] += weighted[x, y] * r[y]
            for t in range(2):
                if at[t] >= at[s]:
                    block = slot[at[s], at[t]]
                    product = matmul(weighted, J[t])
                    for x in range(6):
                        for y in range(6):
                            H[block, x, y] += product[x, y]
    return cost


@kernel
def _add_priors(
    R: Array, p: Array, known: Ints, R_mean: Array, p_mean: Array, information: Array, gravity_aligned: bool,
    position: Ints, slot: Ints, H: Array, g: Array,
) -> float:  # fmt: skip
    cost = 0.0
    for i in range(len(known)):
        k = known[i]
        at, M = position[k], np.eye(6)
        block, gradient = np.zeros((6, 6)), np.zeros(6)
        cost += add_pose_prior(R[k], p[k], R_mean[i], p_mean[i], information[i], block, gradient)
        if at < 0:
            continue
        if gravity_aligned:
            _keep_yaw(M, R[k])
        block = matmul(matmul(transposed(M), block), M)
        for x in range(6):
            for y in range(6):
                H[slot[at, at], x, y] += block[x, y]
                g[at, x] += M[y, x] * gradient[y]
    return cost


@kernel
def _keep_yaw(J: Array, R: Array) -> None:
    """Columns of the rotation become (0, 0, yaw about world z): R Exp(R^T e_z yaw)."""
    for x in range(6):
        J[x, 2] = J[x, 0] * R[2, 0] + J[x, 1] * R[2, 1] + J[x, 2] * R[2, 2]
        J[x, 0] = J[x, 1] = 0.0


@kernel
def _moved(R: Array, p: Array, position: Ints, step: Array, gravity_aligned: bool) -> tuple[Array, Array]:
    new_R, new_p = R.copy(), p.copy()
    w = np.empty(3)
    for k in range(len(position)):
        i = position[k]
        if i < 0:
            continue
        for a in range(3):
            w[a] = R[k, 2, a] * step[i, 2] if gravity_aligned else step[i, a]
            new_p[k, a] += step[i, 3 + a]
        turned = so3_perturbed(R[k], w)
        for a in range(3):
            for b in range(3):
                new_R[k, a, b] = turned[a, b]
    return new_R, new_p
