"""Points from rays: exact without noise, as uncertain as they say with it, and refused where they cannot be known."""

from __future__ import annotations

import numpy as np
import pytest

from lodelight.geometry.se3 import SE3
from lodelight.geometry.triangulate import triangulate_pairs, triangulate_rays


def noisy(rays, sigma, rng):
    """Rays turned by Gaussian angles, sigma rad about each of the two axes across."""
    out = rays + sigma * rng.normal(size=rays.shape)  # the part along the ray only scales it
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def two_views(rng, n, baseline=0.3, sigma=0.0, at=0.0):
    T_a = SE3.exp(rng.normal(size=6) * 0.3 + np.array([0, 0, 0, at, at, at]))
    T_b = SE3(T_a.R @ SE3.exp(rng.normal(size=6) * 0.05).R, T_a.t + T_a.R @ np.array([baseline, 0.0, 0.0]))
    X = T_a @ np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(1.5, 4, n)])
    rays = []
    for T in (T_a, T_b):
        f = T.inverse() @ X
        rays.append(noisy(f / np.linalg.norm(f, axis=1, keepdims=True), sigma, rng))
    return T_a, rays[0], T_b, rays[1], X


@pytest.mark.parametrize("at", [0.0, 1e5])
def test_pairs_are_exact_without_noise(at):
    T_a, fa, T_b, fb, X = two_views(np.random.default_rng(0), 200, at=at)
    xyz, good = triangulate_pairs(T_a, fa, np.full(200, 1e-3), T_b, fb, np.full(200, 1e-3))
    assert good.all()
    assert np.abs(xyz - X).max() < 1e-10 + 1e-14 * at / 0.1  # what rounding of the coordinates leaves at this parallax


def test_covariance_says_the_truth_about_pairs_and_tracks():
    rng = np.random.default_rng(1)
    m, sigma = 2000, 1e-3
    for views in (2, 5):
        centres = rng.normal(size=(m, views, 3)) * 0.3
        X = np.array([0.0, 0.0, 3.0]) + rng.normal(size=(m, 3)) * 0.3
        rays = X[:, None] - centres
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        rays = noisy(rays.reshape(-1, 3), sigma, rng)
        found = triangulate_rays(centres.reshape(-1, 3), rays, np.full(m * views, sigma), np.arange(m + 1) * views)
        known = (
            found.relative_sigma < 0.1
        )  # beyond, the depth's distribution is skewed and has no covariance to speak of
        assert known.mean() > 0.9
        d = (found.xyz - X)[known]
        nees = np.einsum("ni,ni->n", d, np.linalg.solve(found.covariance[known], d[:, :, None])[:, :, 0])
        assert 0.9 < nees.mean() / 3 < 1.1  # its own deviation is 0.02
        assert abs(found.chi2[known].mean() / (2 * views - 3) - 1.0) < 0.1


def test_few_true_pairs_and_many_false_ones_are_told_apart():
    rng = np.random.default_rng(2)
    T_a, fa, T_b, fb, _ = two_views(rng, 2000, sigma=1e-3)
    sigma = np.full(2000, 1e-3)
    assert triangulate_pairs(T_a, fa, sigma, T_b, fb, sigma)[1].mean() > 0.9  # 95 % less the far ones
    assert triangulate_pairs(T_a, fa, sigma, T_b, np.roll(fb, 1, axis=0), sigma)[1].mean() < 0.05


def test_points_behind_or_without_parallax_are_refused():
    rng = np.random.default_rng(3)
    T_a, fa, T_b, fb, _ = two_views(rng, 100, sigma=1e-4)
    sigma = np.full(100, 1e-3)
    assert not triangulate_pairs(T_a, -fa, sigma, T_b, -fb, sigma)[1].any()
    T_a, fa, T_b, fb, _ = two_views(rng, 100, baseline=1e-3, sigma=1e-3)
    assert not triangulate_pairs(T_a, fa, sigma, T_b, fb, sigma)[1].any()
    _, good = triangulate_pairs(T_a, fa, sigma, T_a, fa, sigma)  # the same ray twice
    assert not good.any()


def test_a_track_of_one_ray_or_none_is_no_point():
    found = triangulate_rays(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones(1), np.array([0, 1, 1]))
    assert np.isnan(found.xyz).all()
    assert not found.in_front.any()
