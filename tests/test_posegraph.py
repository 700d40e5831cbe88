"""Pose graphs against closed forms, scipy's least squares and known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimator_scenes import chart_error
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.estimation.factors.relative_pose import relative_pose
from lodelight.estimation.posegraph import PoseGraph, optimize_pose_graph
from lodelight.geometry.se3 import SE3

SIGMA = np.array([0.002] * 3 + [0.01] * 3)


def graph_of(start: list[SE3], edges: list[tuple[int, int, SE3]], sigma=SIGMA, doubtful=None) -> PoseGraph:
    return PoseGraph(
        R=np.array([T.R for T in start]),
        p=np.array([T.t for T in start]),
        fixed=np.arange(len(start)) == 0,
        a=np.array([a for a, _, _ in edges]),
        b=np.array([b for _, b, _ in edges]),
        R_ab=np.array([T.R for _, _, T in edges]),
        p_ab=np.array([T.t for _, _, T in edges]),
        information=np.tile(np.diag(sigma**-2.0), (len(edges), 1, 1)),
        doubtful=doubtful,
    )


def poses(result) -> list[SE3]:
    return [SE3(R, p) for R, p in zip(result.R, result.p, strict=True)]


def rounds(rng, poses_per_round, n_rounds, tilt=0.0, noise=1.0, wrong=0):
    """A robot that circles a hall: odometry, loops between rounds, a start by odometry alone; and the truth."""
    n = poses_per_round * n_rounds
    truth = []
    for k in range(n):
        a = 2 * np.pi * k / poses_per_round
        level = SE3.exp(np.array([0.0, 0.0, a, 0.0, 0.0, 0.0]))
        truth.append(
            SE3(level.R @ SE3.exp(tilt * rng.normal(size=6)).R, np.array([5 * np.cos(a), 5 * np.sin(a), 0.01 * k]))
        )

    def measured(a, b):
        return a, b, (truth[a].inverse() @ truth[b]).perturbed(noise * SIGMA * rng.normal(size=6))

    edges = [measured(k, k + 1) for k in range(n - 1)]
    edges += [measured(k, k + poses_per_round) for k in range(0, n - poses_per_round, 3)]
    doubtful = np.arange(len(edges)) >= n - 1
    for e in rng.choice(np.flatnonzero(doubtful), wrong, replace=False):
        edges[e] = (*edges[e][:2], SE3.exp(rng.normal(size=6)))
    start = [truth[0]]
    for _, _, T in edges[: n - 1]:
        start.append(start[-1] @ T)
    return graph_of(start, edges, doubtful=doubtful), truth


def test_relative_pose_jacobians_match_central_differences():
    rng = np.random.default_rng(0)

    def residual(A, B, M):
        r, Ja, Jb = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
        relative_pose(A.R, A.t, B.R, B.t, M.R, M.t, r, Ja, Jb)
        return r, Ja, Jb

    for _ in range(20):
        A, B = SE3.exp(rng.normal(size=6)), SE3.exp(rng.normal(size=6))
        M = (A.inverse() @ B).perturbed(0.5 * rng.normal(size=6))
        r, Ja, Jb = residual(A, B, M)
        predicted = A.inverse() @ B
        np.testing.assert_allclose(M.perturbed(r).matrix, predicted.matrix, atol=1e-12)
        for k in range(6):
            d = np.zeros(6)
            d[k] = 1e-6
            numeric_a = residual(A.perturbed(d), B, M)[0] - residual(A.perturbed(-d), B, M)[0]
            numeric_b = residual(A, B.perturbed(d), M)[0] - residual(A, B.perturbed(-d), M)[0]
            np.testing.assert_allclose(numeric_a / 2e-6, Ja[:, k], atol=1e-8)
            np.testing.assert_allclose(numeric_b / 2e-6, Jb[:, k], atol=1e-8)


def test_gap_of_a_loop_is_shared_equally():
    """Equal edges without rotation: the closed form is that each takes its share of the gap."""
    n, gap = 10, np.array([0.3, -0.2, 0.1])
    step = SE3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    back = SE3(np.eye(3), np.array([-float(n), 0.0, 0.0]) + gap)
    start = [SE3(np.eye(3), np.array([float(k), 0.0, 0.0])) for k in range(n + 1)]
    edges = [(k, k + 1, step) for k in range(n)] + [(n, 0, back)]
    # rotation is held stiff, so that it takes no share
    result = optimize_pose_graph(graph_of(start, edges, sigma=np.array([1e-7] * 3 + [0.01] * 3)))
    expected = np.outer(np.arange(n + 1), [1.0, 0.0, 0.0] - gap / (n + 1))
    np.testing.assert_allclose(result.p, expected, atol=2e-5)  # it ends 1e-3 of a sigma of 1 cm before the optimum


@pytest.mark.parametrize("robust", ["none", "huber"])
def test_graph_agrees_with_scipy(robust):
    graph, _ = rounds(np.random.default_rng(1), 8, 3, noise=3.0)
    ours = optimize_pose_graph(graph, robust=robust, iterations=100)
    n = len(graph.R)
    whiten = 1.0 / SIGMA

    def residuals(x):
        at = [SE3(graph.R[0], graph.p[0])]
        at += [SE3(graph.R[k], graph.p[k]).perturbed(x[6 * k - 6 : 6 * k]) for k in range(1, n)]
        out = []
        for a, b, R, p, doubtful in zip(graph.a, graph.b, graph.R_ab, graph.p_ab, graph.doubtful, strict=True):
            predicted = at[a].inverse() @ at[b]
            r = whiten * np.append(SE3(R.T @ predicted.R, np.zeros(3)).log()[:3], predicted.t - p)
            norm = np.linalg.norm(r)
            if robust == "huber" and doubtful and norm**2 > 12.592:
                r *= np.sqrt(2 * np.sqrt(12.592) * norm - 12.592) / norm
            out.append(r)
        return np.concatenate(out)

    theirs = least_squares(residuals, np.zeros(6 * (n - 1)), xtol=1e-14, ftol=1e-14, x_scale="jac")
    assert ours.cost[-1] == pytest.approx(2 * theirs.cost, rel=1e-7)


def test_closed_loops_undo_the_drift():
    graph, truth = rounds(np.random.default_rng(2), 100, 5)
    result = optimize_pose_graph(graph)
    before = np.linalg.norm(graph.p - [T.t for T in truth], axis=1)
    after = np.linalg.norm(result.p - [T.t for T in truth], axis=1)
    assert after.max() < 0.3 * before.max()
    dof = 6 * (len(graph.a) - len(truth) + 1)
    assert abs(result.cost[-1] / dof - 1.0) < 5 * np.sqrt(2 / dof)  # chi-square of as many degrees of freedom


@pytest.mark.parametrize("robust", ["huber", "dcs"])
def test_wrong_loops_are_let_go(robust):
    rng = np.random.default_rng(3)
    clean, truth = rounds(rng, 60, 4)
    graph, _ = rounds(np.random.default_rng(3), 60, 4, wrong=6)
    error = {}
    for name, g, kernel in (("clean", clean, "none"), ("trusting", graph, "none"), ("robust", graph, robust)):
        result = optimize_pose_graph(g, robust=kernel, iterations=60)
        error[name] = np.sqrt(np.mean(np.sum((result.p - [T.t for T in truth]) ** 2, axis=1)))
    assert error["robust"] < (1.5 if robust == "dcs" else 4.0) * error["clean"]
    assert error["trusting"] > 5.0 * error["robust"]


def test_gravity_alignment_keeps_roll_and_pitch():
    graph, truth = rounds(np.random.default_rng(4), 40, 3, tilt=0.1, noise=0.0)
    rng = np.random.default_rng(5)
    turned = [
        SE3(SE3.exp(np.array([0, 0, a, 0, 0, 0])).R @ T.R, T.t + d)
        for T, a, d in zip(
            truth, 0.1 * rng.normal(size=len(truth)), 0.2 * rng.normal(size=(len(truth), 3)), strict=True
        )
    ]
    turned[0] = truth[0]
    start = replace(graph, R=np.array([T.R for T in turned]), p=np.array([T.t for T in turned]))
    result = optimize_pose_graph(start, gravity_aligned=True)
    # the third row of R_world_body is what the body knows of "up": no yaw changes it
    np.testing.assert_allclose(result.R[:, 2], start.R[:, 2], atol=1e-12)
    assert max(np.abs(chart_error(a, b)).max() for a, b in zip(poses(result), truth, strict=True)) < 1e-6


@pytest.mark.parametrize("gravity_aligned", [False, True])
def test_priors_place_a_graph_that_nothing_holds(gravity_aligned):
    graph, truth = rounds(np.random.default_rng(6), 30, 2, noise=0.0)
    off = SE3.exp(np.array([0.0, 0.0, 0.3, 1.0, -2.0, 0.5]))
    moved = [off @ T for T in truth]
    priors = [PosePrior(k, truth[k], np.diag([1e4] * 3 + [1e4] * 3)) for k in (0, 17, 40)]
    loose = replace(
        graph,
        fixed=np.zeros(60, bool),
        R=np.array([T.R for T in moved]),
        p=np.array([T.t for T in moved]),
        priors=priors,
    )
    result = optimize_pose_graph(loose, gravity_aligned=gravity_aligned, iterations=50)
    assert max(np.abs(chart_error(a, b)).max() for a, b in zip(poses(result), truth, strict=True)) < 1e-5


def test_graph_repeats_to_the_byte_and_survives_what_nothing_holds():
    graph, _ = rounds(np.random.default_rng(7), 30, 3)
    a, b = (optimize_pose_graph(graph, robust="dcs") for _ in range(2))
    assert a.R.tobytes() == b.R.tobytes()
    assert a.p.tobytes() == b.p.tobytes()
    island = replace(graph, fixed=np.zeros(len(graph.R), bool), a=graph.a[1:], b=graph.b[1:], R_ab=graph.R_ab[1:],
                     p_ab=graph.p_ab[1:], information=graph.information[1:], doubtful=graph.doubtful[1:])  # fmt: skip
    assert np.isfinite(optimize_pose_graph(island).p).all()
