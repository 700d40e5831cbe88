"""Where the camera is, from the lights it sees and which way is up.

Minimises the reprojection of the lights' outlines' centres, whitened by the noise of their pixels and of the survey,
and the angle between measured and assumed up. Started from two lights in closed form and from every P3P solution, so
that both poses of a flat ceiling are tried; up chooses between them. Source: science note A4, A5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.p3p import p3p
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew
from lodelight.lights.conic import conic_centre, disc_axes, image_of_disc
from lodelight.lights.two_lights import poses_from_two_lights
from lodelight.types import Array

HUBER = 2.0  # sigmas of one light's two coordinates
CHI2_2_99 = 9.21
STEPS = 20


@dataclass(frozen=True, eq=False)
class Views:
    """What is known of N sightings and of up.

    rays : (N, 3), camera frame, z = 1; sigma : (N,) of x / z and y / z; lights : N of them
    moved : (N, 6) how far the camera is from its pose when each was seen (rotation rad, camera frame; m, world)
    up_cam : unit; sigma_tilt_rad : its error about both horizontal axes
    """

    rays: Array
    sigma: Array
    lights: tuple[Light, ...]
    moved: Array
    up_cam: Array
    sigma_tilt_rad: float

    @property
    def xyz(self) -> Array:
        return np.array([light.xyz for light in self.lights])

    def of(self, keep: Sequence[int]) -> Views:
        rows = list(keep)
        lights = tuple(self.lights[i] for i in rows)
        return Views(self.rays[rows], self.sigma[rows], lights, self.moved[rows], self.up_cam, self.sigma_tilt_rad)


@dataclass(frozen=True, eq=False)
class Solution:
    """T_world_cam; covariance (6, 6), rotation (camera axes) first; chi2 (N,) of the sightings, tilt2 of up."""

    T_world_cam: SE3
    covariance: Array
    chi2: Array
    tilt2: float

    @property
    def cost(self) -> float:
        return float(np.sum(np.minimum(self.chi2, 4.0 * CHI2_2_99))) + self.tilt2


def solve(views: Views) -> Solution | None:
    """The best pose over all starts; None where none is possible. At least two lights."""
    found = [refined for start in _starts(views) if (refined := refine(start, views)) is not None]
    return min(found, key=lambda s: s.cost, default=None)


def _starts(views: Views) -> list[SE3]:
    """Two lights and up, for the pair widest apart; with three, the P3P poses of the widest triangle."""
    n, xyz = len(views.lights), views.xyz
    i, j = max(combinations(range(n), 2), key=lambda ij: float(np.linalg.norm(views.rays[ij[0]] - views.rays[ij[1]])))
    starts = poses_from_two_lights(views.rays[[i, j]], xyz[[i, j]], views.up_cam)
    if n >= 3:

        def area(ijk: Iterable[int]) -> float:
            a, b, c = views.rays[list(ijk)]
            return float(np.linalg.norm(np.cross(b - a, c - a)))

        rows = list(max(combinations(range(n), 3), key=area))
        unit = views.rays[rows] / np.linalg.norm(views.rays[rows], axis=1)[:, None]
        R, c = np.empty((4, 3, 3)), np.empty((4, 3))
        starts += [SE3(R[k].copy(), c[k].copy()) for k in range(p3p(unit, xyz[rows], R, c))]
    return starts


def refine(start: SE3, views: Views) -> Solution | None:
    """Levenberg-Marquardt from a pose, Huber on each light; None where a light would be behind the camera."""
    T, damping = start, 1e-4
    now = _linearized(T, views)
    if now is None:
        return None
    for _ in range(STEPS):
        H, g, cost = now[0], now[1], now[2]
        step = np.asarray(np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(6), -g), np.float64)
        there = T.perturbed(step)
        then = _linearized(there, views)
        if then is None or then[2] > cost:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        T, now, damping = SE3.from_matrix(there.matrix), then, max(damping / 10.0, 1e-9)
        if cost - then[2] < 1e-9 * (1.0 + cost):
            break
    H = now[0]
    if not np.isfinite(H).all() or np.linalg.cond(_unit_free(H)) > 1e10:
        return None
    return Solution(T, np.asarray(np.linalg.inv(H), np.float64), now[3], now[4])


def _unit_free(H: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    out: Array = H * scale[:, None] * scale[None, :]
    return out


def misfits(T: SE3, views: Views) -> Array:
    """(N,) distance between each light's expected and measured centre, normalized coordinates."""
    out = np.empty(len(views.lights))
    for i, light in enumerate(views.lights):
        seen = T.perturbed(views.moved[i])
        out[i] = np.linalg.norm(_misfit(seen, light, views.rays[i])[1])
    return out


def _misfit(seen: SE3, light: Light, ray: Array) -> tuple[Array, Array]:
    """The light in the camera (3,), and where its ellipse is centred less where it was measured (2,)."""
    X = seen.R.T @ (light.xyz - seen.t)
    return X, conic_centre(image_of_disc(X, seen.R.T @ light.normal, light.radius_m)) - ray[:2]


def _linearized(T: SE3, views: Views) -> tuple[Array, Array, float, Array, float] | None:
    """Normal matrix, gradient, robust cost, chi2 (N,) and tilt2 at a pose."""
    H, g, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    chi2 = np.empty(len(views.lights))
    for i, light in enumerate(views.lights):
        seen = T.perturbed(views.moved[i])
        X, r = _misfit(seen, light, views.rays[i])
        if X[2] < 0.05:
            return None
        E = np.array([[1.0, 0.0, -X[0] / X[2]], [0.0, 1.0, -X[1] / X[2]]]) / X[2]
        noise = views.sigma[i] ** 2 * np.eye(2) + light.sigma_m**2 * E @ E.T
        J = np.hstack([E @ skew(X), -E @ seen.R.T])
        W = np.linalg.inv(noise)
        chi2[i] = r @ W @ r
        k = math.sqrt(chi2[i])
        weight = 1.0 if k <= HUBER else HUBER / k
        cost += chi2[i] if k <= HUBER else 2.0 * HUBER * k - HUBER**2
        H += weight * J.T @ W @ J
        g += weight * J.T @ W @ r
    up = T.R[2]
    B = disc_axes(views.up_cam)
    tilt = B @ up / views.sigma_tilt_rad
    if up @ views.up_cam < 0.0:
        tilt = tilt + np.sign(tilt) * 2.0 / views.sigma_tilt_rad  # upside down is not level
    J = np.hstack([B @ skew(up) / views.sigma_tilt_rad, np.zeros((2, 3))])
    H += J.T @ J
    g += J.T @ tilt
    tilt2 = float(tilt @ tilt)
    return H, g, cost + tilt2, chi2, tilt2
