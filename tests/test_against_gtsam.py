"""The same problems given to GTSAM (extra "reference"): equal optimum, equal covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator_scenes import LENSES, T_BODY_CAM, chart_error, walk
from lodelight.estimation.bundle import bundle_adjust
from lodelight.estimation.posegraph import optimize_pose_graph
from lodelight.geometry.se3 import SE3
from test_posegraph import SIGMA, rounds

gtsam = pytest.importorskip("gtsam", reason="needs GTSAM 4.3: pip install lodelight[reference]")


def pose3(T):
    return gtsam.Pose3(gtsam.Rot3(T.R), T.t)


def se3(pose):
    return SE3(pose.rotation().matrix(), np.asarray(pose.translation()))


def pinned():
    return gtsam.noiseModel.Constrained.All(6)


def optimum(graph, values):
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    params.setAbsoluteErrorTol(1e-14)
    params.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def test_bundle_adjustment_agrees_with_gtsam():
    made = walk(np.random.default_rng(1), LENSES["radtan"], 8, 120, per_point=5.0)
    often = np.bincount(made.problem.point, minlength=120)[made.problem.point] >= 3
    names = ("keyframe", "point", "px", "sigma_px", "inv_depth", "sigma_inv_depth")
    problem = replace(made.problem, **{name: getattr(made.problem, name)[often] for name in names})
    ours = bundle_adjust(problem, 50, robust=False, covariance_of=range(8))

    fx, fy, cx, cy, k1, k2, p1, p2 = problem.camera.params[:8]
    lens, body_sensor = gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, k1, k2, p1, p2), pose3(T_BODY_CAM)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(8):
        T = SE3(problem.R[k], problem.p[k])
        values.insert(k, pose3(T))
        if problem.fixed[k]:
            graph.add(gtsam.PriorFactorPose3(k, pose3(T), pinned()))
    for m in np.unique(problem.point):
        values.insert(1000 + int(m), problem.xyz[m])
    for k, m, px, sigma in zip(problem.keyframe, problem.point, problem.px, problem.sigma_px, strict=True):
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        graph.add(gtsam.GenericProjectionFactorCal3DS2(px, noise, int(k), 1000 + int(m), lens, body_sensor))
    theirs = optimum(graph, values)
    assert ours.cost[-1] == pytest.approx(2.0 * graph.error(theirs), rel=1e-9)
    marginals = gtsam.Marginals(graph, theirs)
    for k in range(2, 8):
        d = chart_error(SE3(ours.R[k], ours.p[k]), se3(theirs.atPose3(k)))
        assert d @ np.linalg.solve(ours.covariance[k], d) < 1e-4  # a hundredth of a standard deviation
        to_world = np.eye(6)  # GTSAM moves the position along the body's axes, we along the world's
        to_world[3:, 3:] = ours.R[k]
        expected = to_world @ marginals.marginalCovariance(k) @ to_world.T
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            ours.covariance[k] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-3
        )


def test_pose_graph_agrees_with_gtsam():
    """Its residual is the logarithm of the whole motion, ours of its rotation: equal to first order in the noise."""
    ours_graph, _ = rounds(np.random.default_rng(2), 40, 4)
    ours = optimize_pose_graph(ours_graph)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (R, p) in enumerate(zip(ours_graph.R, ours_graph.p, strict=True)):
        values.insert(k, pose3(SE3(R, p)))
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), pinned()))
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMA)
    for a, b, R, p in zip(ours_graph.a, ours_graph.b, ours_graph.R_ab, ours_graph.p_ab, strict=True):
        graph.add(gtsam.BetweenFactorPose3(int(a), int(b), pose3(SE3(R, p)), noise))
    theirs = optimum(graph, values)
    assert ours.cost[-1] == pytest.approx(2.0 * graph.error(theirs), rel=1e-3)
    for k in range(len(ours_graph.R)):
        # against an uncertainty of centimetres
        assert np.abs(chart_error(SE3(ours.R[k], ours.p[k]), se3(theirs.atPose3(k)))).max() < 1e-3
