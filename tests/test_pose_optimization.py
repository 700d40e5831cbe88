"""The reprojection factor and the motion-only estimator, against derivatives, OpenCV and statistics."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from estimator_scenes import LENSES, T_BODY_CAM, chart_error, random_pose, random_view
from lodelight.estimation.factors.reprojection import reprojection
from lodelight.estimation.pose import optimize_pose
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3


def evaluate(camera, T, X, px, inv_depth):
    rows, r, *J = reprojection(
        camera.model,
        camera.params,
        T.R,
        T.t,
        T_BODY_CAM.R,
        T_BODY_CAM.t,
        *X,
        *px,
        1.3,
        inv_depth,
        0.02,
        np.zeros((2, 3)),
    )
    return rows, np.array(r)[:rows], np.array(J)[:rows]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("depth", [0.0, 1.0])
def test_reprojection_jacobians_match_central_differences(lens, depth):
    camera, rng = LENSES[lens], np.random.default_rng(1)
    for _ in range(20):
        T = random_pose(rng)
        view = random_view(rng, T, camera, 1, depth=depth)
        X, px, inv = view.xyz[0], view.px[0], float(view.inv_depth[0])
        rows, _, J = evaluate(camera, T, X, px, inv)
        assert rows == (3 if depth else 2)
        h = 1e-6
        for k in range(6):
            d = np.zeros(6)
            d[k] = h
            numeric = (
                evaluate(camera, T.perturbed(d), X, px, inv)[1] - evaluate(camera, T.perturbed(-d), X, px, inv)[1]
            ) / (2 * h)
            analytic = J[:, k] if k < 3 else -J[:, k]
            # central differences of step 1e-6: rounding 1e-10 of residuals of hundreds
            np.testing.assert_allclose(numeric, analytic, rtol=1e-5, atol=1e-3)
        for k in range(3):
            d = np.zeros(3)
            d[k] = h
            numeric = (evaluate(camera, T, X + d, px, inv)[1] - evaluate(camera, T, X - d, px, inv)[1]) / (2 * h)
            np.testing.assert_allclose(numeric, J[:, 3 + k], rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("lens", LENSES)
def test_residual_is_zero_at_the_truth(lens):
    rng = np.random.default_rng(2)
    T = random_pose(rng)
    view = random_view(rng, T, LENSES[lens], 50, noise=0.0)
    for i in range(50):
        _, r, _ = evaluate(LENSES[lens], T, view.xyz[i], view.px[i], view.inv_depth[i])
        assert np.abs(r).max() < 1e-8


def test_a_point_behind_the_camera_has_no_rows():
    camera = LENSES["radtan"]
    behind = T_BODY_CAM @ np.array([0.1, 0.1, -2.0])
    assert evaluate(camera, SE3.identity(), behind, np.zeros(2), 0.0)[0] == 0


@pytest.mark.parametrize("lens", LENSES)
def test_pose_is_exact_without_noise(lens):
    rng = np.random.default_rng(3)
    T = random_pose(rng)
    view = random_view(rng, T, LENSES[lens], 100, noise=0.0)
    start = T.perturbed(rng.normal(size=6) * 0.1)
    result = optimize_pose(start, T_BODY_CAM, LENSES[lens], *view.observations)
    assert np.abs(chart_error(result.T_world_body, T)).max() < 1e-7  # the exit is at 1e-5 of a sigma of 1e-3
    assert result.n_inliers == 100


def test_poses_predicted_from_poses_stay_rotations():
    """Constant velocity inverts by transposing, so what rounding leaves of a rotation would grow 2.4 times a frame."""
    rng = np.random.default_rng(14)
    camera, step = LENSES["radtan"], SE3.exp(np.array([0.0, 0.01, 0.0, 0.01, 0.0, 0.0]))
    before = random_pose(rng)
    now = before @ step
    for _ in range(100):
        truth = now @ step
        view = random_view(rng, truth, camera, 20, noise=0.0)
        predicted = now @ (before.inverse() @ now)
        result = optimize_pose(predicted, T_BODY_CAM, camera, *view.observations)
        before, now = now, result.T_world_body
    assert np.abs(now.R.T @ now.R - np.eye(3)).max() < 1e-14  # rounding of one product; 1e22 before this was found


def test_pose_agrees_with_opencv():
    rng = np.random.default_rng(4)
    camera = Camera.create("radtan", 752, 480, (458.0, 457.0, 367.0, 248.0), (-0.28, 0.074, 2e-4, 1.8e-5))
    T = random_pose(rng)
    view = random_view(
        rng, T, camera, 60, noise=0.5, depth=0.0
    )  # half the noise: no inlier is lost, so costs are equal
    sigma = np.ones(60)
    view.px[:] = np.round(view.px, 6)
    start = T.perturbed(rng.normal(size=6) * 0.02)
    ours = optimize_pose(
        start, T_BODY_CAM, camera, view.xyz, view.px, 3.0 * sigma, view.inv_depth, view.sigma_inv_depth
    )
    assert ours.n_inliers == 60
    T_cam_world = (start @ T_BODY_CAM).inverse()
    rvec, tvec = cv2.solvePnPRefineLM(
        view.xyz, view.px, camera.K, np.array(camera.distortion), T_cam_world.log()[:3].reshape(3, 1),
        T_cam_world.t.reshape(3, 1).copy(), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-14),
    )  # fmt: skip
    theirs = SE3(cv2.Rodrigues(rvec)[0], tvec.ravel()).inverse() @ T_BODY_CAM.inverse()
    assert np.abs(chart_error(ours.T_world_body, theirs)).max() < 1e-6  # 1e-3 of the estimate's own sigma


@pytest.mark.parametrize("lens", LENSES)
def test_half_of_the_matches_may_be_wrong(lens):
    rng = np.random.default_rng(5)
    for _ in range(20):
        T = random_pose(rng)
        view = random_view(rng, T, LENSES[lens], 200, outliers=0.5)
        start = T.perturbed(rng.normal(size=6) * 0.01)
        result = optimize_pose(start, T_BODY_CAM, LENSES[lens], *view.observations)
        d = chart_error(result.T_world_body, T)
        assert d @ np.linalg.solve(result.covariance, d) < 35  # chi-square, 6 dof: above once in 200,000


@pytest.mark.parametrize("depth", [0.0, 0.5])
def test_pose_covariance_says_the_truth_about_the_error(depth):
    rng = np.random.default_rng(6)
    squared = []
    for _ in range(300):
        T = random_pose(rng)
        view = random_view(rng, T, LENSES["radtan"], 80, depth=depth)
        result = optimize_pose(T.perturbed(rng.normal(size=6) * 0.02), T_BODY_CAM, LENSES["radtan"], *view.observations)
        d = chart_error(result.T_world_body, T)
        squared.append(d @ np.linalg.solve(result.covariance, d))
    assert 0.8 < np.mean(squared) / 6 < 1.25  # its own deviation over 300 seeds is 0.03


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_points_widen_the_covariance(n):
    rng = np.random.default_rng(7)
    T = random_pose(rng)
    view = random_view(rng, T, LENSES["radtan"], n, depth=0.0)
    result = optimize_pose(T, T_BODY_CAM, LENSES["radtan"], *view.observations)
    assert np.all(np.isfinite(result.covariance))
    assert np.all(np.isfinite(result.T_world_body.t))
    assert np.linalg.eigvalsh(result.covariance)[-1] > 1.0  # a free direction: metres or radians, not millimetres


def test_points_behind_the_camera_are_outliers():
    rng = np.random.default_rng(8)
    T = random_pose(rng)
    view = random_view(rng, T, LENSES["radtan"], 60)
    centre = (T @ T_BODY_CAM).t
    view.xyz[:10] = 2 * centre - view.xyz[:10]
    result = optimize_pose(T, T_BODY_CAM, LENSES["radtan"], *view.observations)
    assert not result.inliers[:10].any()
    assert np.all(np.isinf(result.chi2[:10]))
    assert result.n_inliers > 40


def test_what_is_not_a_number_is_not_seen():
    rng = np.random.default_rng(12)
    T = random_pose(rng)
    view = random_view(rng, T, LENSES["double_sphere"], 60)
    view.xyz[3], view.px[7, 1] = np.nan, np.nan
    result = optimize_pose(T, T_BODY_CAM, LENSES["double_sphere"], *view.observations)
    assert not result.inliers[[3, 7]].any()
    assert result.n_inliers > 45
    assert np.isfinite(result.covariance).all()


def test_a_prior_pulls_by_its_information():
    """With nothing else measured the prior is the answer; against points, the information adds up."""
    rng = np.random.default_rng(9)
    T = random_pose(rng)
    mean = T.perturbed(rng.normal(size=6) * 0.05)
    information = np.diag([1e4, 2e4, 3e4, 1e3, 2e3, 3e3])
    none = random_view(rng, T, LENSES["radtan"], 0)
    alone = optimize_pose(T, T_BODY_CAM, LENSES["radtan"], *none.observations, prior=(mean, information))
    assert np.abs(chart_error(alone.T_world_body, mean)).max() < 1e-6
    np.testing.assert_allclose(np.linalg.inv(alone.covariance), information, rtol=1e-3, atol=1.0)

    view = random_view(rng, T, LENSES["radtan"], 30, depth=0.0)
    free = optimize_pose(T, T_BODY_CAM, LENSES["radtan"], *view.observations)
    held = optimize_pose(T, T_BODY_CAM, LENSES["radtan"], *view.observations, prior=(T, information))
    assert np.all(np.linalg.eigvalsh(free.covariance - held.covariance) > -1e-9)


def test_weight_scales_information_and_not_the_outlier_test():
    rng = np.random.default_rng(10)
    T = random_pose(rng)
    view = random_view(rng, T, LENSES["radtan"], 100)
    full = optimize_pose(T, T_BODY_CAM, LENSES["radtan"], *view.observations)
    half = optimize_pose(T, T_BODY_CAM, LENSES["radtan"], *view.observations, information_weight=np.full(100, 0.5))
    assert np.array_equal(full.inliers, half.inliers)
    np.testing.assert_allclose(half.covariance, 2 * full.covariance, rtol=1e-4)


def test_pose_repeats_to_the_byte():
    rng = np.random.default_rng(11)
    T = random_pose(rng)
    view = random_view(rng, T, LENSES["equidistant"], 200, outliers=0.2)
    a, b = (optimize_pose(T, T_BODY_CAM, LENSES["equidistant"], *view.observations) for _ in range(2))
    assert a.T_world_body.matrix.tobytes() == b.T_world_body.matrix.tobytes()
    assert a.covariance.tobytes() == b.covariance.tobytes()
