"""Points, cameras and noisy observations with known truth, for the tests and benchmarks of the estimators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.estimation.bundle_problem import BundleProblem
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.types import Array, Bools

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


@dataclass(frozen=True, eq=False)
class Walk:
    """A bundle problem and the truth behind it."""

    problem: BundleProblem
    truth: list[SE3]
    xyz: Array
    wrong: Bools


def walk(
    rng: np.random.Generator,
    camera: Camera,
    keyframes: int,
    points: int,
    per_point: float = 5.0,
    step_m: float = 0.15,
    noise: float = 1.0,
    depth: float = 0.0,
    outliers: float = 0.0,
    fixed: int = 2,
    sigma_rad: float = 0.01,
    sigma_m: float = 0.02,
) -> Walk:
    """Keyframes along a circle that look outwards, at points 2 to 5 m before them; the start is off by the sigmas.

    per_point : mean observations per point; noise multiplies the errors, not the sigmas; a mismatch lands 30 px away
    """
    radius = max(1.5, keyframes * step_m / (2 * np.pi))
    turn = step_m / radius * np.arange(keyframes)
    truth, rows = [], []
    bearing = rng.uniform(-0.3, turn[-1] + 0.3, points)
    reach = radius + rng.uniform(2.0, 5.0, points)
    X = np.column_stack([reach * np.cos(bearing), reach * np.sin(bearing), rng.uniform(-0.5, 2.5, points)])
    for k, a in enumerate(turn):
        y, z = np.array([0.0, 0.0, -1.0]), np.array([np.cos(a), np.sin(a), 0.0])
        T_world_cam = SE3(np.column_stack([np.cross(y, z), y, z]), radius * z + [0.0, 0.0, 1.0])
        T_world_cam = T_world_cam.perturbed(rng.normal(size=6) * 0.03)
        truth.append(T_world_cam @ T_BODY_CAM.inverse())
        X_cam = T_world_cam.inverse() @ X
        px, seen = camera.project(X_cam)
        i = np.flatnonzero(seen & (X_cam[:, 2] > 0.5) & (np.abs(np.linalg.norm(X_cam, axis=1)) < 7.0))
        rows.append((np.full(len(i), k), i, px[i], X_cam[i, 2]))
    keyframe, point, px, z = (np.concatenate(column) for column in zip(*rows, strict=True))
    kept = rng.random(len(keyframe)) < per_point * points / len(keyframe)
    keyframe, point, px, z = keyframe[kept], point[kept], px[kept], z[kept]
    n = len(keyframe)
    sigma_px, sigma_inv_depth = 1.2 ** rng.integers(0, 4, n), np.full(n, 0.01)
    px = px + noise * sigma_px[:, None] * rng.normal(size=(n, 2))
    wrong = rng.random(n) < outliers
    angle = rng.uniform(0, 2 * np.pi, n)
    px[wrong] += 30.0 * np.column_stack([np.cos(angle), np.sin(angle)])[wrong]
    inv_depth = np.maximum(1.0 / z + noise * sigma_inv_depth * rng.normal(size=n), 1e-3)
    inv_depth[rng.random(n) >= depth] = 0.0
    held = np.arange(keyframes) < fixed
    off = np.array([sigma_rad] * 3 + [sigma_m] * 3)
    start = [T if f else T.perturbed(rng.normal(size=6) * off) for T, f in zip(truth, held, strict=True)]
    problem = BundleProblem(
        camera=camera,
        T_body_cam=T_BODY_CAM,
        R=np.array([T.R for T in start]),
        p=np.array([T.t for T in start]),
        fixed=held,
        xyz=X + rng.normal(size=X.shape) * sigma_m,
        keyframe=keyframe,
        point=point,
        px=px,
        sigma_px=sigma_px,
        inv_depth=inv_depth,
        sigma_inv_depth=sigma_inv_depth,
    )
    return Walk(problem, truth, X, wrong)
