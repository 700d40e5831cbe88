"""Bundle adjustment against scipy's least squares, known truth and statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimator_scenes import LENSES, T_BODY_CAM, chart_error, walk
from lodelight.estimation.bundle import bundle_adjust
from lodelight.estimation.bundle_problem import BundleProblem
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.geometry.se3 import SE3


def poses(result):
    return [SE3(R, p) for R, p in zip(result.R, result.p, strict=True)]


def residuals(problem: BundleProblem, poses: list[SE3], xyz) -> np.ndarray:
    """The whole residual in plain numpy: the twin of the kernels."""
    X_cam = np.empty((len(problem.keyframe), 3))
    for k, T in enumerate(poses):
        rows = problem.keyframe == k
        X_cam[rows] = (T @ T_BODY_CAM).inverse() @ xyz[problem.point[rows]]
    r = (problem.camera.project(X_cam)[0] - problem.px) / problem.sigma_px[:, None]
    weight = np.ones(len(r)) if problem.weight is None else problem.weight
    deep = problem.inv_depth > 0
    rd = ((1.0 / X_cam[:, 2] - problem.inv_depth) / problem.sigma_inv_depth)[deep]
    return np.concatenate([(r * np.sqrt(weight)[:, None]).ravel(), rd * np.sqrt(weight)[deep]])


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("depth", [0.0, 0.6])
def test_adjustment_agrees_with_scipy(lens, depth):
    rng = np.random.default_rng(1)
    made = walk(rng, LENSES[lens], 5, 16, per_point=4.5, depth=depth)
    many = np.bincount(made.problem.point, minlength=16)[made.problem.point] >= 2
    problem = replace(
        made.problem,
        weight=rng.uniform(0.2, 1.0, many.sum()),
        **{
            name: getattr(made.problem, name)[many]
            for name in ("keyframe", "point", "px", "sigma_px", "inv_depth", "sigma_inv_depth")
        },
    )
    ours = bundle_adjust(problem, 50, robust=False, covariance_of=range(5))
    start = [SE3(R, p) for R, p in zip(problem.R, problem.p, strict=True)]
    free = np.flatnonzero(~problem.fixed)

    def state(x):
        moved = list(start)
        for i, k in enumerate(free):
            moved[k] = start[k].perturbed(x[6 * i : 6 * i + 6])
        return moved, problem.xyz + x[6 * len(free) :].reshape(-1, 3)

    theirs = least_squares(
        lambda x: residuals(problem, *state(x)), np.zeros(6 * len(free) + 48), x_scale="jac", xtol=1e-12, ftol=1e-12
    )
    assert ours.cost[-1] == pytest.approx(2 * theirs.cost, abs=1e-6)  # where our next step promises less than that
    for k in free:
        d = chart_error(poses(ours)[k], state(theirs.x)[0][k])
        assert d @ np.linalg.solve(ours.covariance[k], d) < 1e-4  # a hundredth of a standard deviation


@pytest.mark.parametrize("lens", LENSES)
def test_adjustment_is_exact_without_noise(lens):
    made = walk(np.random.default_rng(2), LENSES[lens], 8, 150, noise=0.0)
    result = bundle_adjust(made.problem, 30)
    assert result.cost[-1] < 1e-5  # where the next step promises less than 1e-6
    assert max(np.abs(chart_error(a, b)).max() for a, b in zip(poses(result), made.truth, strict=True)) < 1e-5


def test_two_stages_find_the_outliers():
    made = walk(np.random.default_rng(3), LENSES["radtan"], 15, 600, depth=0.3, outliers=0.1)
    result = bundle_adjust(made.problem, 5, polish=10)
    assert np.mean(result.inliers[made.wrong]) < 0.1  # some points of two or three sightings follow the wrong one
    assert np.mean(result.inliers[~made.wrong]) > 0.9
    clean = replace(
        made.problem,
        **{
            name: getattr(made.problem, name)[~made.wrong]
            for name in ("keyframe", "point", "px", "sigma_px", "inv_depth", "sigma_inv_depth")
        },
    )
    best = bundle_adjust(clean, 20, robust=False)
    error = [
        np.mean([np.linalg.norm(a.t - b.t) for a, b in zip(poses(r), made.truth, strict=True)]) for r in (result, best)
    ]
    assert error[0] < 2.0 * error[1]


@pytest.mark.parametrize("depth", [0.0, 0.5])
def test_covariance_of_poses_says_the_truth_about_their_error(depth):
    squared = []
    for seed in range(200):
        made = walk(np.random.default_rng(seed), LENSES["radtan"], 6, 80, depth=depth)
        result = bundle_adjust(made.problem, 10, polish=10, covariance_of=[2, 5])
        for k, covariance in zip((2, 5), result.covariance, strict=True):
            d = chart_error(SE3(result.R[k], result.p[k]), made.truth[k])
            squared.append(d @ np.linalg.solve(covariance, d))
    assert 0.8 < np.mean(squared) / 6 < 1.25


def test_covariance_is_the_inverse_of_the_whole_information():
    made = walk(np.random.default_rng(4), LENSES["radtan"], 5, 40, depth=1.0, noise=0.1)
    result = bundle_adjust(made.problem, 30, robust=False, covariance_of=[0, 2, 4])
    n = 5 * 6 + 40 * 3

    def residual(x):
        moved = [T.perturbed(x[6 * k : 6 * k + 6]) for k, T in enumerate(poses(result))]
        return residuals(made.problem, moved, result.xyz + x[30:].reshape(-1, 3))

    J = np.column_stack([(residual(1e-6 * e) - residual(-1e-6 * e)) / 2e-6 for e in np.eye(n)])[:, 12:]
    seen = np.abs(J).sum(axis=0) > 0  # a point that nobody sees has no column
    expected = np.linalg.inv(J[:, seen].T @ J[:, seen])
    assert np.all(result.covariance[0] == 0.0)
    for at, block in ((1, slice(0, 6)), (2, slice(12, 18))):
        scale = np.sqrt(np.diag(expected[block, block]))
        np.testing.assert_allclose(
            result.covariance[at] / np.outer(scale, scale), expected[block, block] / np.outer(scale, scale), atol=1e-4
        )


def test_points_seen_once_do_not_disturb_the_poses():
    """A ray without depth says nothing of the pose from which it is seen."""
    made = walk(np.random.default_rng(5), LENSES["radtan"], 6, 80)
    problem = made.problem
    n, extra = len(problem.keyframe), 40
    rng = np.random.default_rng(6)
    more = replace(
        problem,
        xyz=np.vstack([problem.xyz, problem.xyz[:extra] + 0.1]),
        keyframe=np.append(problem.keyframe, rng.integers(0, 6, extra)),
        point=np.append(problem.point, np.arange(80, 80 + extra)),
        px=np.vstack([problem.px, rng.uniform(100, 400, (extra, 2))]),
        sigma_px=np.append(problem.sigma_px, np.ones(extra)),
        inv_depth=np.append(problem.inv_depth, np.zeros(extra)),
        sigma_inv_depth=np.append(problem.sigma_inv_depth, np.ones(extra)),
    )
    a, b = bundle_adjust(problem, 30, robust=False), bundle_adjust(more, 30, robust=False, covariance_of=[5])
    assert np.isfinite(b.xyz).all()
    assert np.isfinite(b.covariance).all()
    assert max(np.abs(chart_error(x, y)).max() for x, y in zip(poses(a), poses(b), strict=True)) < 1e-4  # 0.1 sigma
    assert len(b.inliers) == n + extra


def test_priors_hold_what_points_leave_free():
    """No fixed pose: two priors give position, heading and scale; the answer is as sure as they are."""
    made = walk(np.random.default_rng(7), LENSES["radtan"], 8, 200, fixed=0)
    information = np.diag([1e6] * 3 + [1e6] * 3)
    priors = [PosePrior(k, made.truth[k], information) for k in (0, 7)]
    result = bundle_adjust(replace(made.problem, priors=priors), 20, covariance_of=[0, 4])
    for k, covariance in zip((0, 4), result.covariance, strict=True):
        d = chart_error(SE3(result.R[k], result.p[k]), made.truth[k])
        assert d @ np.linalg.solve(covariance, d) < 35  # chi-square, 6 dof: above once in 200,000
        assert np.sqrt(np.diag(covariance)).max() < 0.02
    floating = bundle_adjust(made.problem, 20, covariance_of=[4])
    assert np.isfinite(floating.R).all()
    assert np.sqrt(np.diag(floating.covariance[0])).max() > 1.0


def test_fixed_poses_and_fixed_points_do_not_move():
    made = walk(np.random.default_rng(8), LENSES["radtan"], 6, 60, fixed=1)
    surveyed = np.arange(60) < 10
    result = bundle_adjust(
        replace(made.problem, xyz=np.where(surveyed[:, None], made.xyz, made.problem.xyz), fixed_points=surveyed), 10
    )
    assert np.array_equal(result.R[0], made.problem.R[0])
    assert np.array_equal(result.xyz[surveyed], made.xyz[surveyed])
    assert not np.array_equal(result.xyz[~surveyed], made.problem.xyz[~surveyed])


def test_cost_never_rises_within_a_stage_and_stop_is_obeyed():
    made = walk(np.random.default_rng(9), LENSES["equidistant"], 10, 300, outliers=0.05, sigma_m=0.1, sigma_rad=0.05)
    result = bundle_adjust(made.problem, 20)
    assert np.all(np.diff(result.cost) <= 0)
    asked = []
    stopped = bundle_adjust(made.problem, 20, stop=lambda: asked.append(0) or len(asked) > 3)
    assert stopped.cost == result.cost[:4]


def test_degenerate_problems_return_what_they_were_given():
    made = walk(np.random.default_rng(10), LENSES["radtan"], 4, 30)
    none = {
        name: getattr(made.problem, name)[:0]
        for name in ("keyframe", "point", "px", "sigma_px", "inv_depth", "sigma_inv_depth")
    }
    result = bundle_adjust(replace(made.problem, **none), 10, polish=5, covariance_of=[3])
    assert np.array_equal(result.p, made.problem.p)
    assert np.array_equal(result.xyz, made.problem.xyz)
    assert np.isfinite(result.covariance).all()
    held = bundle_adjust(replace(made.problem, fixed=np.ones(4, bool)), 10)
    assert np.array_equal(held.R, made.problem.R)
    assert held.cost[-1] < held.cost[0]  # the points are adjusted to the poses


def test_the_same_point_twice_in_one_keyframe_counts_twice():
    made = walk(np.random.default_rng(11), LENSES["radtan"], 4, 40)
    names = ("keyframe", "point", "px", "sigma_px", "inv_depth", "sigma_inv_depth")
    twice = replace(made.problem, **{n: np.concatenate([getattr(made.problem, n)] * 2) for n in names})
    weighted = replace(made.problem, weight=np.full(len(made.problem.keyframe), 2.0))
    a, b = bundle_adjust(twice, 30, robust=False), bundle_adjust(weighted, 30, robust=False)
    np.testing.assert_allclose(a.p, b.p, atol=1e-9)


def test_adjustment_repeats_to_the_byte_whatever_the_order_of_calls():
    made = walk(np.random.default_rng(12), LENSES["radtan"], 12, 300, outliers=0.05)
    a, b = (bundle_adjust(made.problem, 5, polish=5, covariance_of=[3]) for _ in range(2))
    for x, y in ((a.R, b.R), (a.p, b.p), (a.xyz, b.xyz), (a.covariance, b.covariance), (a.chi2, b.chi2)):
        assert x.tobytes() == y.tobytes()
