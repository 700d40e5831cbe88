"""Bundle adjustment with an IMU: keyframe poses, velocities, biases and points of a whole flight together.

What `bundle` does, and between one keyframe and the next the preintegrated IMU (`factors/inertial`). A keyframe of the
chain has three nodes of six unknowns in the system that is factored: its pose, (velocity, gyroscope's bias), and
(accelerometer's bias, three that mean nothing). No prior of the window comes in: nothing is counted twice, and nothing
stays linearized where it was wrong. Derivation: docs/derivations-inertial.md. Source: science note C1, C3.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.bundle import Adjustment, Linear, State
from lodelight.estimation.bundle_problem import BundleProblem, BundleResult, as_f64
from lodelight.estimation.factors.inertial import DP, DR, MEASUREMENT, inertial_jacobian, inertial_residual
from lodelight.types import AnyArray, Array, Bools, Ints

SIGMA_BIAS_GYRO, SIGMA_BIAS_ACCEL = 0.1, 0.2  # rad/s, m/s^2: of a chain's first biases, about zero
STILL_M_S, STILL_M = 0.01, 0.001  # at a standstill, as in the window
P_ROWS, P_END = slice(3, 6), 5  # of a link's residuals; the last of the way's
REST = 9  # velocity, gyroscope's bias, accelerometer's bias


@dataclass(frozen=True, eq=False)
class ImuChain:
    """L measurements between keyframes that follow one another, of a problem of K keyframes. Gravity is along -z.

    before, after (L,) rows of the problem; measured (L, 76), whiten (L, 15, 15) as of `window_frames.prepared`
    first (C,) : rows at which a chain begins; rest (K, 9) : where velocities (world) and biases start from
    still (S,) : rows at a standstill: their velocity is zero
    """

    before: Ints
    after: Ints
    measured: Array
    whiten: Array
    first: Ints
    rest: Array
    still: Ints = field(default_factory=lambda: np.zeros(0, np.int32))


def inertial_bundle_adjust(problem: BundleProblem, chain: ImuChain, iterations: int = 15) -> tuple[BundleResult, Array]:
    """The most likely flight, and its velocities and biases (K, 9). The problem should leave the vertical free: no
    fixed pose, but a prior on one whose position and yaw define the frame."""
    adjustment = InertialAdjustment(problem, [], chain)
    adjustment.run(iterations, True, None)
    adjustment.drop_outliers()
    rest = adjustment.state.rest
    assert rest is not None
    return adjustment.result(()), rest


def standing() -> tuple[Array, Array]:
    """measured (76,), whiten (15, 15) of two keyframes of one standstill: the second is where the first was."""
    measured, whiten = np.zeros(MEASUREMENT), np.zeros((15, 15))
    measured[DR : DR + 9] = np.eye(3).ravel()
    whiten[range(3, 6), range(3, 6)] = 1.0 / STILL_M
    return measured, whiten


def lengths(chain: ImuChain, R: AnyArray, p: AnyArray, variance: Array) -> ImuChain:
    """With the lengths that the path had until now: from each keyframe of a chain's first half to one of its second.

    R (K, 3, 3), p (K, 3) : the path; variance (K,) m^2 : of its positions, an axis. All err by one scale, so all the
    lengths of a chain together count as one of them.
    """
    members = np.unique(np.concatenate([chain.before, chain.after]))
    chains = np.split(members, np.searchsorted(members, chain.first[1:]))
    halves = np.array([len(rows) // 2 for rows in chains])
    before = np.concatenate([rows[:half] for rows, half in zip(chains, halves, strict=True)])
    after = np.concatenate([rows[half : 2 * half] for rows, half in zip(chains, halves, strict=True)])
    measured, whiten = _ways(before, after, R, p), np.zeros((len(before), 15, 15))
    way = measured[:, DP : DP + 3]
    sigma = np.sqrt(np.repeat(halves, halves) * (np.maximum(variance[after], variance[before]) + STILL_M**2))
    whiten[:, P_END, P_ROWS] = way / (sigma * np.maximum(np.linalg.norm(way, axis=1), 1e-9))[:, None]
    return _joined(chain, before, after, measured, whiten)


def tied(chain: ImuChain, unseen: Bools, R: AnyArray, p: AnyArray, variance: Array) -> ImuChain:
    """With keyframes that have no points (K,) left where the path (see `lengths`) had them beside the next ones."""
    pairs = np.unique(np.stack([chain.before, chain.after], axis=1), axis=0)
    before, after = pairs[unseen[pairs].any(axis=1)].T
    whiten = np.zeros((len(before), 15, 15))
    sigma = np.sqrt(np.maximum(variance[before], variance[after]) + STILL_M**2)
    for row in range(3, 6):
        whiten[:, row, row] = 1.0 / sigma
    return _joined(chain, before, after, _ways(before, after, R, p), whiten)


def _ways(before: Ints, after: Ints, R: AnyArray, p: AnyArray) -> Array:
    """(L, 76) of links over no time: from where to where the path went, in the frame of the first."""
    R, p = np.asarray(R, np.float64), np.asarray(p, np.float64)
    measured = np.zeros((len(before), MEASUREMENT))
    measured[:, DR : DR + 9] = np.eye(3).ravel()
    measured[:, DP : DP + 3] = np.einsum("kji,kj->ki", R[before], p[after] - p[before])
    return measured


def _joined(chain: ImuChain, before: Ints, after: Ints, measured: Array, whiten: Array) -> ImuChain:
    return replace(
        chain,
        before=np.concatenate([chain.before, before]).astype(np.int32),
        after=np.concatenate([chain.after, after]).astype(np.int32),
        measured=np.concatenate([chain.measured, measured]),
        whiten=np.concatenate([chain.whiten, whiten]),
    )


@dataclass
class InertialAdjustment(Adjustment):
    chain: ImuChain | None = None

    def __post_init__(self) -> None:
        assert self.chain is not None
        self.members = np.unique(np.concatenate([self.chain.before, self.chain.after])).astype(np.int32)
        super().__post_init__()
        k, q = len(self.problem.R), len(self.members)
        poses = int(np.count_nonzero(self.position >= 0))
        place = np.full((k, 3), -1, np.int32)  # of every keyframe's three nodes in the factored system
        place[:, 0] = self.position
        place[self.members, 1] = self.plan.position[poses : poses + q]
        place[self.members, 2] = self.plan.position[poses + q :]
        self.place = place
        for state in (self.state, self.trial):
            state.rest = as_f64(self.chain.rest).copy()
        chain_H = np.zeros((len(self.chain.before), 36, 36))
        for linear in (self.linear, self.trial_linear):
            linear.chain_H = chain_H
            linear.chain_g = np.zeros((k, REST))

    def _coupled(self, poses: Bools, node: Ints) -> Bools:
        """Behind the poses the first, then the second further node of every member."""
        assert self.chain is not None
        n, q = len(poses), len(self.members)
        out = np.zeros((n + 2 * q, n + 2 * q), bool)
        out[:n, :n] = poses
        row = np.full(len(self.problem.R), -1)
        row[self.members] = np.arange(q)
        for i, j in zip(self.chain.before, self.chain.after, strict=True):
            nodes = [node[i], n + row[i], n + q + row[i], node[j], n + row[j], n + q + row[j]]
            there = np.array([x for x in nodes if x >= 0])
            out[np.ix_(there, there)] = True
        return out

    def _linearize(self, at: State, out: Linear, robust: bool, before: Array) -> float:
        comparable = super()._linearize(at, out, robust, before)
        if at.rest is None or out.chain_H is None or out.chain_g is None or self.chain is None:
            return comparable
        c = self.chain
        x = np.hstack([at.R.reshape(-1, 9), at.p, at.rest])
        extra = link_terms(x, c.before, c.after, c.measured, c.whiten, out.chain_H, out.chain_g, out.U, out.g_pose)
        bias = at.rest[c.first, 3:] * self._first_information
        out.chain_g[c.first, 3:] += bias
        extra += float((bias * at.rest[c.first, 3:]).sum())
        velocity = at.rest[c.still, :3] / STILL_M_S**2
        out.chain_g[c.still, :3] += velocity
        extra += float((velocity * at.rest[c.still, :3]).sum())
        out.cost += extra
        return comparable + extra

    @property
    def _first_information(self) -> Array:
        return np.repeat([SIGMA_BIAS_GYRO, SIGMA_BIAS_ACCEL], 3) ** -2.0

    def _reduce(self, damping: float) -> bool:
        assert self.chain is not None
        c, at = self.chain, self.linear
        assert at.chain_H is not None
        assert at.chain_g is not None
        self._reduce_points(damping)
        place, info = self.place, self._first_information
        add_links(damping, c.before, c.after, place, self.plan.slot, at.chain_H, self.S)
        for k in self.members:
            self.b[place[k, 1]] = -at.chain_g[k, :6]
            self.b[place[k, 2], :3], self.b[place[k, 2], 3:] = -at.chain_g[k, 6:], 0.0
            self.S[self.plan.slot[place[k, 2], place[k, 2]], range(3, 6), range(3, 6)] += 1.0
        for k in c.first:
            self.S[self.plan.slot[place[k, 1], place[k, 1]], range(3, 6), range(3, 6)] += info[:3]
            self.S[self.plan.slot[place[k, 2], place[k, 2]], range(3), range(3)] += info[3:]
        for k in c.still:
            self.S[self.plan.slot[place[k, 1], place[k, 1]], range(3), range(3)] += STILL_M_S**-2.0
        return self.plan.factor(self.S)

    def _step(self, damping: float) -> float | None:
        gain = super()._step(damping)
        if gain is None or self.state.rest is None or self.trial.rest is None or self.linear.chain_g is None:
            return gain
        d = np.zeros((len(self.place), REST))
        d[self.members, :6] = self.b[self.place[self.members, 1]]
        d[self.members, 6:] = self.b[self.place[self.members, 2], :3]
        self.trial.rest[:] = self.state.rest + d
        return gain - float((self.linear.chain_g * d).sum())


@kernel
def link_terms(
    x: Array, before: Ints, after: Ints, measured: Array, whiten: Array, H: Array, g_rest: Array, U: Array,
    g_pose: Array,
) -> float:  # fmt: skip
    """Fill H (L, 36, 36), of the six nodes of each link, and g_rest (K, 9); add what is a pose's own to U (K, 6, 6),
    upper half, and g_pose (K, 6). Returns the cost. x (K, 21) : states as of `factors.inertial`."""
    r, J = np.empty(15), np.empty((15, 30))
    white, w = np.empty((15, 36)), np.empty(15)
    H[:] = 0.0
    g_rest[:] = 0.0
    cost = 0.0
    for m in range(len(before)):
        ends = (before[m], after[m])
        inertial_residual(x[ends[0]], x[ends[1]], measured[m], r)
        inertial_jacobian(x[ends[0]], x[ends[1]], measured[m], r, J)
        white[:] = 0.0
        for a in range(15):
            w[a] = 0.0
            for b in range(a + 1):
                scale = whiten[m, a, b]
                w[a] += scale * r[b]
                for s in range(2):
                    for c in range(15):
                        white[a, 18 * s + c] += scale * J[b, 15 * s + c]
            cost += w[a] * w[a]
        for a in range(15):
            for i in range(36):
                f = white[a, i]
                if f != 0.0:
                    for j in range(36):
                        H[m, i, j] += f * white[a, j]
                    k, part = ends[i // 18], i % 18
                    if part < 6:
                        g_pose[k, part] += f * w[a]
                    elif part < 15:
                        g_rest[k, part - 6] += f * w[a]
        for s in range(2):
            for i in range(6):
                for j in range(i, 6):
                    U[ends[s], i, j] += H[m, 18 * s + i, 18 * s + j]
    return cost


@kernel
def add_links(damping: float, before: Ints, after: Ints, place: Ints, slot: Ints, H: Array, S: Array) -> None:
    """Add the links to S (n_blocks, 6, 6), but for what is a pose's own and has come with the poses."""
    nodes = np.empty(6, np.int64)
    for m in range(len(before)):
        for c in range(3):
            nodes[c], nodes[3 + c] = place[before[m], c], place[after[m], c]
        for x in range(6):
            for y in range(6):
                i, j = nodes[x], nodes[y]
                if i < 0 or j < 0 or j < i or (x == y and x % 3 == 0):
                    continue
                s = slot[i, j]
                for a in range(6):
                    for b in range(6):
                        S[s, a, b] += H[m, 6 * x + a, 6 * y + b]
                    if x == y:
                        S[s, a, a] += damping * H[m, 6 * x + a, 6 * x + a]
