"""One motion of two views, from rays alone, when the rotation is nearly known or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import rotation_angle, so3_exp
from lodelight.geometry.two_view import fit_two_view, turn_between

SIGMA = 1e-3  # rad, half a pixel


def rays(
    rng: np.random.Generator, T_b_a: SE3, n: int = 150, outliers: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    X = rng.uniform([-3, -2, 2], [3, 2, 8], (n, 3))
    a = X / np.linalg.norm(X, axis=1)[:, None] + SIGMA / 2 * rng.standard_normal((n, 3))
    b = T_b_a @ X
    b = b / np.linalg.norm(b, axis=1)[:, None] + SIGMA / 2 * rng.standard_normal((n, 3))
    wrong = np.arange(n) < outliers * n
    b[wrong] += rng.uniform(-0.1, 0.1, (wrong.sum(), 3))
    unit = [v / np.linalg.norm(v, axis=1)[:, None] for v in (a, b)]
    return unit[0], unit[1], wrong


@pytest.mark.parametrize("off_rad", [0.0, 0.004])
def test_wrong_pairs_are_found_with_a_gyroscope_that_has_a_bias(off_rad):
    rng = np.random.default_rng(3)
    T = SE3.exp(np.array([0.02, -0.03, 0.01, 0.1, 0.03, -0.05]))
    a, b, wrong = rays(rng, T, outliers=0.2)
    believed = T.R @ so3_exp(np.array([off_rad, -off_rad, off_rad]))
    R, t, inlier, parallax = fit_two_view(a, b, believed, 0.01, SIGMA, 3.0, 1)
    assert np.count_nonzero(inlier[~wrong]) > 0.97 * np.count_nonzero(~wrong)
    # a wrong pair passes if it happens to lie in its epipolar plane: 3 sigma of 100 mrad either way
    assert np.count_nonzero(inlier[wrong]) <= 0.15 * np.count_nonzero(wrong)
    assert rotation_angle(R.T @ T.R) < 1e-3
    assert t @ T.t / np.linalg.norm(T.t) > np.cos(np.radians(3.0))
    assert 0.01 < parallax < 0.05


def test_same_input_gives_same_bytes():
    a, b, _ = rays(np.random.default_rng(1), SE3.exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0])), outliers=0.3)
    first, second = (fit_two_view(a, b, np.eye(3), 0.03, SIGMA, 3.0, 7) for _ in range(2))
    assert all(np.array_equal(x, y) for x, y in zip(first, second, strict=True))


def test_too_few_pairs_are_all_kept():
    a, b, _ = rays(np.random.default_rng(1), SE3.identity(), n=4)
    _, t, inlier, _ = fit_two_view(a, b, np.eye(3), 0.01, SIGMA, 3.0, 1)
    assert inlier.all()
    assert not t.any()


def test_images_alone_show_the_turn():
    """To within the parallax of a small translation: 2 cm at 2 to 8 m."""
    rng = np.random.default_rng(5)
    T = SE3.exp(np.array([0.05, 0.1, -0.08, 0.02, 0.0, 0.01]))
    a, b, _ = rays(rng, T, outliers=0.2)
    assert rotation_angle(turn_between(a, b).T @ T.R) < 0.006
