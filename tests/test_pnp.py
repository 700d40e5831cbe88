"""The minimal solver against OpenCV's, and robust poses against the truth with most matches wrong."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from estimator_scenes import LENSES
from lodelight.geometry.p3p import p3p
from lodelight.geometry.pnp import ransac_absolute_orientation, ransac_pnp
from lodelight.geometry.se3 import SE3

SIGMA_RAD, SIGMA_M = 2e-3, 0.02


def solve(rays, xyz):
    R, c = np.empty((4, 3, 3)), np.empty((4, 3))
    n = p3p(np.ascontiguousarray(rays), np.ascontiguousarray(xyz), R, c)
    return [SE3(R[i].copy(), c[i].copy()) for i in range(n)]


def triangle(rng):
    T = SE3.exp(rng.normal(size=6))
    rays = rng.normal(size=(3, 3)) + np.array([0.0, 0.0, 1.0])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return T, rays, T @ (rays * rng.uniform(0.5, 8.0, (3, 1)))


def matches(rng, n, wrong_share, lens="radtan"):
    """Rays and points of n matches of which a share goes to another point."""
    camera = LENSES[lens]
    T = SE3.exp(rng.normal(size=6))
    rays, seen = camera.unproject(rng.uniform([5, 5], [camera.width - 5, camera.height - 5], (n, 2)))
    assert seen.all()
    X_cam = rays * rng.uniform(1.0, 6.0, (n, 1))
    rays = rays + SIGMA_RAD * rng.normal(size=(n, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    wrong = rng.random(n) < wrong_share
    rays[wrong] = rng.permutation(rays)[: wrong.sum()]
    return T, rays, T @ X_cam, wrong


def test_p3p_always_has_the_truth_among_its_answers():
    rng = np.random.default_rng(0)
    for _ in range(3000):
        T, rays, xyz = triangle(rng)
        found = solve(rays, xyz)
        assert 1 <= len(found) <= 4
        # double roots lose half the digits
        assert min(np.abs(a.R - T.R).max() + np.abs(a.t - T.t).max() for a in found) < 1e-5
        for a in found:
            again = a.inverse() @ xyz
            assert np.abs(again / np.linalg.norm(again, axis=1, keepdims=True) - rays).max() < 1e-7
            assert np.linalg.det(a.R) == pytest.approx(1.0)


def test_p3p_finds_what_opencv_finds():
    rng = np.random.default_rng(1)
    for _ in range(300):
        T = SE3.exp(rng.normal(size=6))
        xy = rng.uniform(-0.7, 0.7, (3, 2))
        X_cam = np.column_stack([xy, np.ones(3)]) * rng.uniform(1.0, 6.0, (3, 1))
        xyz = T @ X_cam
        n, rvecs, tvecs = cv2.solveP3P(xyz, xy.reshape(3, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
        rays = X_cam / np.linalg.norm(X_cam, axis=1, keepdims=True)
        ours = solve(rays, xyz)
        for i in range(n):
            theirs = SE3(cv2.Rodrigues(rvecs[i])[0], tvecs[i].ravel()).inverse()
            X = theirs.inverse() @ xyz
            if np.abs(X / np.linalg.norm(X, axis=1, keepdims=True) - rays).max() < 1e-6:  # some of theirs are not exact
                assert min(np.abs(a.t - theirs.t).max() for a in ours) < 1e-4


def test_p3p_solves_the_symmetric_cases():
    """A square tag seen head on: isosceles triangle, camera on its axis, where leading coefficients vanish."""
    for tilt in (0.0, 1e-9, 1e-4):
        T = SE3.exp(np.array([tilt, 0.0, 0.0, 0.0, 0.0, 0.0]))
        X_cam = np.array([[-0.1, -0.1, 1.0], [0.1, -0.1, 1.0], [0.1, 0.1, 1.0]])
        found = solve(X_cam / np.linalg.norm(X_cam, axis=1, keepdims=True), T @ X_cam)
        assert found
        # a double root here: the pose is known to the root of the rounding
        assert min(np.abs(a.t - T.t).max() for a in found) < 1e-5


def test_p3p_has_no_answer_for_points_on_a_line_or_alike():
    rays = np.eye(3)
    assert solve(rays, np.array([[0.0, 0, 1], [0, 0, 2], [0, 0, 3]])) == []
    assert solve(rays, np.zeros((3, 3))) == []


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("wrong_share", [0.0, 0.5, 0.8])
def test_ransac_finds_the_pose_among_wrong_matches(lens, wrong_share):
    rng = np.random.default_rng(2)
    for _ in range(20):
        T, rays, xyz, wrong = matches(rng, 200, wrong_share, lens)
        found = ransac_pnp(rays, xyz, np.full(200, SIGMA_RAD))
        assert found is not None
        T_world_cam, agrees = found
        error = T.inverse() @ T_world_cam
        assert error.angle < 0.01
        assert np.linalg.norm(error.t) < 0.03
        assert agrees[~wrong].mean() > 0.6  # 0.95 of hundreds; some 40 are left where most are wrong
        assert agrees[wrong].sum() < 0.1 * max(wrong.sum(), 1)


def test_ransac_agrees_with_opencv_on_clean_matches():
    rng = np.random.default_rng(3)
    _, rays, xyz, _ = matches(rng, 100, 0.0)
    T_world_cam, agrees = ransac_pnp(rays, xyz, np.full(100, 4 * SIGMA_RAD))  # so wide that all agree
    assert agrees.all()
    xy = rays[:, :2] / rays[:, 2:]
    _, rvec, tvec = cv2.solvePnP(xyz, xy.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    theirs = SE3(cv2.Rodrigues(rvec)[0], tvec.ravel()).inverse()
    # they weigh the image plane, we weigh angles: the answers differ by less than either's error
    assert np.abs(T_world_cam.t - theirs.t).max() < 2e-3
    assert (T_world_cam.inverse() @ theirs).angle < 1e-3


def test_points_sorted_by_score_save_draws_and_not_accuracy():
    rng = np.random.default_rng(4)
    right = {False: 0, True: 0}
    for _ in range(30):
        T, rays, xyz, wrong = matches(rng, 200, 0.9)
        scores = rng.random(200) - 0.5 * wrong
        for scored in right:
            found = ransac_pnp(
                rays, xyz, np.full(200, SIGMA_RAD), scores=scores if scored else None, max_iterations=300
            )
            right[scored] += found is not None and np.linalg.norm((T.inverse() @ found[0]).t) < 0.1
    assert right[True] > right[False] + 5


def test_absolute_orientation_finds_the_motion_among_wrong_matches():
    rng = np.random.default_rng(5)
    for _ in range(20):
        T = SE3.exp(rng.normal(size=6))
        b = rng.normal(size=(150, 3)) * 2.0
        a = T @ b + SIGMA_M * rng.normal(size=(150, 3))
        wrong = rng.random(150) < 0.7
        a[wrong] = rng.permutation(a)[: wrong.sum()]
        T_a_b, agrees = ransac_absolute_orientation(a, b, np.full(150, SIGMA_M))
        assert np.abs(T_a_b.t - T.t).max() < 0.03
        assert (T.inverse() @ T_a_b).angle < 0.01
        assert agrees[~wrong].mean() > 0.8


def test_too_few_or_degenerate_matches_give_none():
    rng = np.random.default_rng(6)
    _, rays, xyz, _ = matches(rng, 10, 0.0)
    assert ransac_pnp(rays[:3], xyz[:3], np.full(3, SIGMA_RAD)) is None
    assert ransac_pnp(rays, np.zeros((10, 3)), np.full(10, SIGMA_RAD)) is None
    line = np.outer(np.arange(10.0), [1.0, 2.0, 3.0])
    assert ransac_pnp(rays, line, np.full(10, SIGMA_RAD), max_iterations=50) is None
    assert ransac_absolute_orientation(line, line, np.full(10, SIGMA_M), max_iterations=50) is None


def test_ransac_repeats_to_the_byte_and_the_seed_matters():
    rng = np.random.default_rng(7)
    _, rays, xyz, _ = matches(rng, 200, 0.8)
    a, b = (ransac_pnp(rays, xyz, np.full(200, SIGMA_RAD), seed=5) for _ in range(2))
    assert a[0].matrix.tobytes() == b[0].matrix.tobytes()
    assert np.array_equal(a[1], b[1])
