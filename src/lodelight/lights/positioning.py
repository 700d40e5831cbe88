"""Where the camera is, from the lights it sees and which way is up.

Minimises the reprojection of the lights' outlines' centres, whitened by the noise of their pixels and of the survey,
and the angle between measured and assumed up. Started from two lights in closed form and from every P3P solution, so
that both poses of a flat ceiling are tried; up chooses between them. Source: science note A4, A5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.p3p import p3p
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import rotation_angle, skew, so3_exp
from lodelight.lights.conic import conic_centre, image_of_disc
from lodelight.lights.two_lights import poses_from_two_lights
from lodelight.types import Array

HUBER = 2.0  # sigmas of one light's two coordinates
CHI2_2_99 = 9.21
STEPS = 20
NEAR_M, NEAR_RAD = 0.05, math.radians(2.0)  # far less than lies between the two poses of a flat ceiling


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

    @cached_property
    def xyz(self) -> Array:
        return np.array([light.xyz for light in self.lights])

    @cached_property
    def normals(self) -> Array:
        return np.array([light.normal for light in self.lights])

    @cached_property
    def radii_m(self) -> Array:
        return np.array([light.radius_m for light in self.lights])

    @cached_property
    def survey_m2(self) -> Array:
        return np.array([light.sigma_m**2 for light in self.lights])

    @cached_property
    def turns(self) -> Array:
        """(N, 3, 3) how the camera has turned since its pose."""
        return np.array([so3_exp(np.ascontiguousarray(w)) for w in self.moved[:, :3]])

    @cached_property
    def level_axes(self) -> Array:
        """(2, 3): two horizontal unit vectors, camera frame."""
        first = skew(self.up_cam)[:, int(np.argmin(np.abs(self.up_cam)))]
        first = first / math.sqrt(first @ first)
        return np.array([first, skew(self.up_cam) @ first])

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
    found: list[Solution] = []
    for start in _starts(views):
        if any(_near(start, known.T_world_cam) for known in found):
            continue
        refined = refine(start, views)
        if refined is not None:
            found.append(refined)
    return min(found, key=lambda s: s.cost, default=None)


def _near(a: SE3, b: SE3) -> bool:
    """Whether a start lies where a solution has been found already."""
    off_m = a.t - b.t
    return bool(off_m @ off_m < NEAR_M**2 and rotation_angle(a.R.T @ b.R) < NEAR_RAD)


def _starts(views: Views) -> list[SE3]:
    """Two lights and up, for the pair widest apart; with three, the P3P poses of the widest triangle."""
    n, xyz = len(views.lights), views.xyz
    i, j = max(combinations(range(n), 2), key=lambda ij: float(np.linalg.norm(views.rays[ij[0]] - views.rays[ij[1]])))
    starts = poses_from_two_lights(views.rays[[i, j]], xyz[[i, j]], views.up_cam)
    if n >= 3:

        def area(ijk: Iterable[int]) -> float:
            (ax, ay), (bx, by), (cx, cy) = views.rays[list(ijk), :2]
            return float(abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)))

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
    out: Array = np.linalg.norm(_seen(T, views)[2], axis=1)
    return out


def _seen(T: SE3, views: Views) -> tuple[Array, Array, Array]:
    """R_world_cam (N, 3, 3) when each was seen, the lights there (N, 3), and (N, 2) of where their ellipses are
    centred less where that was measured."""
    R = T.R @ views.turns
    X = np.einsum("nji,nj->ni", R, views.xyz - T.t - views.moved[:, 3:])
    normals = np.einsum("nji,nj->ni", R, views.normals)
    return R, X, conic_centre(image_of_disc(X, normals, views.radii_m)) - views.rays[:, :2]


def _linearized(T: SE3, views: Views) -> tuple[Array, Array, float, Array, float] | None:
    """Normal matrix, gradient, robust cost, chi2 (N,) and tilt2 at a pose."""
    R, X, r = _seen(T, views)
    if (X[:, 2] < 0.05).any():
        return None
    n = len(X)
    E = np.zeros((n, 2, 3))
    E[:, 0, 0] = E[:, 1, 1] = 1.0 / X[:, 2]
    E[:, :, 2] = -X[:, :2] / X[:, 2:] ** 2
    noise = views.survey_m2[:, None, None] * (E @ E.transpose(0, 2, 1))
    noise[:, (0, 1), (0, 1)] += views.sigma[:, None] ** 2
    W = np.linalg.inv(noise)
    J = np.empty((n, 2, 6))
    J[:, :, :3] = E @ np.array([skew(x) for x in X])
    J[:, :, 3:] = -E @ R.transpose(0, 2, 1)
    Wr = np.einsum("nij,nj->ni", W, r)
    chi2 = np.einsum("ni,ni->n", r, Wr)
    k = np.sqrt(chi2)
    weight = np.minimum(1.0, HUBER / np.maximum(k, 1e-12))
    cost = float(np.where(k <= HUBER, chi2, 2.0 * HUBER * k - HUBER**2).sum())
    WJ = weight[:, None, None] * (W @ J)
    up = T.R[2]
    tilt = views.level_axes @ up / views.sigma_tilt_rad
    if up @ views.up_cam < 0.0:
        tilt = tilt + np.sign(tilt) * 2.0 / views.sigma_tilt_rad  # upside down is not level
    J_tilt = views.level_axes @ skew(up) / views.sigma_tilt_rad
    H, g = np.einsum("nia,nib->ab", J, WJ), np.einsum("nia,ni->a", WJ, r)
    H[:3, :3] += J_tilt.T @ J_tilt
    g[:3] += J_tilt.T @ tilt
    tilt2 = float(tilt @ tilt)
    return H, g, cost + tilt2, chi2, tilt2
