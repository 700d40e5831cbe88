"""Points, cameras and noisy observations with known truth, for the tests and benchmarks of the estimators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.types import Array

LENSES = {
    "radtan": Camera.create("radtan", 752, 480, (458.0, 457.0, 367.0, 248.0), (-0.28, 0.074, 2e-4, 1.8e-5)),
    "equidistant": Camera.create("equidistant", 512, 512, (191.0, 191.0, 255.0, 257.0), (0.003, 7e-4, -2e-3, 2e-4)),
    "double_sphere": Camera.create("double_sphere", 640, 480, (310.0, 311.0, 322.0, 238.0), (-0.2, 0.59)),
}
T_BODY_CAM = SE3.exp(np.array([1.2, -0.9, 0.7, 0.06, -0.02, 0.04]))


@dataclass(frozen=True, eq=False)
class View:
    """What one camera sees: world points and their noisy measurements."""

    xyz: Array
    px: Array
    sigma_px: Array
    inv_depth: Array
    sigma_inv_depth: Array

    @property
    def observations(self) -> tuple[Array, Array, Array, Array, Array]:
        return self.xyz, self.px, self.sigma_px, self.inv_depth, self.sigma_inv_depth


def random_pose(rng: np.random.Generator) -> SE3:
    return SE3.exp(rng.normal(size=6) * np.array([0.8, 0.8, 0.8, 3.0, 3.0, 1.0]))


def random_view(
    rng: np.random.Generator,
    T_world_body: SE3,
    camera: Camera,
    n: int,
    noise: float = 1.0,
    depth: float = 0.5,
    outliers: float = 0.0,
) -> View:
    """n points spread over the image, 1 to 6 m away along their ray; a fraction with depth, a fraction mismatched.

    noise multiplies the errors but not the sigmas: 0 = exact. A mismatch lands 10 to 100 px away.
    """
    px = rng.uniform([5, 5], [camera.width - 5, camera.height - 5], (n, 2))
    rays, seen = camera.unproject(px)
    while not np.all(seen & (rays[:, 2] > 0.2)):
        bad = ~(seen & (rays[:, 2] > 0.2))
        px[bad] = rng.uniform([5, 5], [camera.width - 5, camera.height - 5], (bad.sum(), 2))
        rays, seen = camera.unproject(px)
    X_cam = rays * rng.uniform(1.0, 6.0, (n, 1))
    sigma_px = 1.2 ** rng.integers(0, 4, n)
    sigma_inv_depth = np.full(n, 0.01)
    measured = px + noise * sigma_px[:, None] * rng.normal(size=(n, 2))
    inv_depth = np.maximum(1.0 / X_cam[:, 2] + noise * sigma_inv_depth * rng.normal(size=n), 1e-3)
    inv_depth[rng.random(n) >= depth] = 0.0
    wrong = rng.random(n) < outliers
    angle, length = rng.uniform(0, 2 * np.pi, n), rng.uniform(10.0, 100.0, n)
    measured[wrong] += (length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))[wrong]
    return View(T_world_body @ T_BODY_CAM @ X_cam, measured, sigma_px, inv_depth, sigma_inv_depth)


def chart_error(estimate: SE3, truth: SE3) -> Array:
    """d (6,) with truth = estimate.perturbed(d)."""
    return np.concatenate([SE3(estimate.R.T @ truth.R, np.zeros(3)).log()[:3], truth.t - estimate.t])
