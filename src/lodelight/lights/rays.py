"""Where a map lies in the world, from single lights seen one after another by a camera whose motion it knows.

The rays to one light from several places meet where it hangs in the map. Two such places and up give yaw and place in
closed form, and tell which lights they are where a code is used again; then all rays are fitted at once, to the survey,
with up as it was measured. One light at a time is enough, where no image shows two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew
from lodelight.lights.two_lights import level
from lodelight.types import Array

RAYS = 6  # that a place is found from
PARALLAX = 0.01  # least eigenvalue of the mean of I - d d^T: rays that open by about 12 degrees
MEETING_M = 0.15  # rms distance of the place from its rays
FITS_M = 0.3  # of a place from its light's survey, and of the distances of two
LIGHTS = 3  # that must fit: two that were swapped fit by themselves
MAP_M = 0.01  # by which a camera's place in the map may be off
STEPS = 8
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Track:
    """One light, followed. candidates : ids of the lights with its code

    centres, directions : (N, 3) of its rays, map frame, m and unit; sigma_rad : (N,)
    """

    candidates: tuple[str, ...]
    centres: Array
    directions: Array
    sigma_rad: Array


@dataclass(frozen=True, eq=False)
class Laid:
    """T_world_map, its covariance (6, 6) as in `SE3.perturbed`, and the lights that fit it."""

    T_world_map: SE3
    covariance: Array
    lights: tuple[str, ...]


def meeting(centres: Array, directions: Array) -> Array | None:
    """(3,) where rays (N, 3) meet; None where they are few, nearly parallel, or do not meet."""
    if len(centres) < RAYS:
        return None
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal = across.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] < PARALLAX:
        return None
    xyz: Array = np.linalg.solve(normal, np.einsum("nij,nj->i", across, centres) / len(centres))
    off = np.einsum("nij,nj->ni", across, xyz - centres)
    return xyz if np.sqrt((off**2).sum(axis=1).mean()) < MEETING_M else None


def lay_down(tracks: Sequence[Track], lights: Mapping[str, Light], up_map: Array, sigma_up_rad: float) -> Laid | None:
    """The place of a map by lights followed in it; None where less than three fit, or more than one place fits as well.

    up_map : (3,) unit, the direction of world z in the map, and its sigma about either horizontal axis
    """
    kept, places = _met(tracks)
    if len(kept) < LIGHTS:
        return None
    found: dict[tuple[str, ...], SE3] = {}
    for T in _starts(kept, places, lights, up_map):
        found.setdefault(_names(T, kept, places, lights), T)
    counts = {names: sum(map(bool, names)) for names in found}
    most = max(counts.values(), default=0)
    best = [names for names, count in counts.items() if count == most]
    if not _enough(most, len(kept)) or len(best) > 1:
        return None
    return fit(found[best[0]], kept, best[0], lights, up_map, sigma_up_rad)


def settle(
    T: SE3, tracks: Sequence[Track], lights: Mapping[str, Light], up_map: Array, sigma_up_rad: float
) -> Laid | None:
    """The place of a map that is known roughly, T_world_map, by all lights followed in it; None as in `lay_down`."""
    kept, places = _met(tracks)
    if not kept:
        return None
    laid: Laid | None = None
    for _ in range(ROUNDS):  # lights far from those that fit at first come within reach as the map turns
        names = _names(T, kept, places, lights)
        laid = fit(T, kept, names, lights, up_map, sigma_up_rad) if sum(map(bool, names)) >= LIGHTS else None
        if laid is None:
            return None
        T = laid.T_world_map
    return laid if laid is not None and _enough(len(laid.lights), len(kept)) else None


def _met(tracks: Sequence[Track]) -> tuple[list[Track], Array]:
    """The tracks whose rays meet, and where (N, 3), map frame."""
    met = [(track, place) for track in tracks if (place := meeting(track.centres, track.directions)) is not None]
    return [track for track, _ in met], np.array([place for _, place in met])


def _enough(fitting: int, of: int) -> bool:
    """Three at least, and all but one of four to six, but two of seven to nine."""
    return fitting >= max(LIGHTS, of - (of - 1) // 3)


def _starts(tracks: list[Track], places: Array, lights: Mapping[str, Light], up_map: Array) -> list[SE3]:
    """T_world_map of every two places and every two lights that are as far apart, level and in height."""
    R_level = level(up_map)
    levelled = places @ R_level.T
    out = []
    for i, j in combinations(range(len(tracks)), 2):
        d = levelled[j] - levelled[i]
        for a, b in product(*([n for n in tracks[k].candidates if n in lights] for k in (i, j))):
            D = lights[b].xyz - lights[a].xyz
            far, apart = math.hypot(D[0], D[1]), math.hypot(d[0], d[1])
            if a == b or abs(far - apart) > FITS_M or abs(D[2] - d[2]) > FITS_M or far < 2.0 * FITS_M:
                continue
            yaw = math.atan2(d[0] * D[1] - d[1] * D[0], d[0] * D[0] + d[1] * D[1])
            R = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
            R = R @ R_level
            out.append(SE3(R, 0.5 * (lights[a].xyz + lights[b].xyz) - R @ (0.5 * (places[i] + places[j]))))
    return out


def _names(T: SE3, tracks: list[Track], places: Array, lights: Mapping[str, Light]) -> tuple[str, ...]:
    """The light that each place is, "" where it is none."""
    return tuple(
        min(
            (name for name in track.candidates if name in lights and _off(T, place, lights[name]) < FITS_M),
            key=lambda name: _off(T, place, lights[name]),
            default="",
        )
        for track, place in zip(tracks, places, strict=True)
    )


def _off(T: SE3, place: Array, light: Light) -> float:
    return float(np.linalg.norm(T @ place - light.xyz))


def fit(
    T: SE3, tracks: Sequence[Track], names: Sequence[str], lights: Mapping[str, Light], up_map: Array, sigma_rad: float
) -> Laid | None:
    """Least squares over all rays of the tracks that have a name, and up; None where it does not converge.

    Residual: the light less the ray's centre, across the ray, in the map; X = R^T (P - t), J = Q [[X]x, -R^T].
    """
    rows = [k for k, name in enumerate(names) if name]
    count = [len(tracks[k].centres) for k in rows]
    c, d = (np.concatenate([getattr(tracks[k], of) for k in rows]) for of in ("centres", "directions"))
    angle = np.concatenate([tracks[k].sigma_rad for k in rows])
    P = np.repeat([lights[names[k]].xyz for k in rows], count, axis=0)
    fixed2 = np.repeat([lights[names[k]].sigma_m ** 2 + MAP_M**2 for k in rows], count)
    share = np.repeat([1.0 / n for n in count], count)  # a light's survey and the map's error are one, not one a ray
    Q = np.eye(3) - d[:, :, None] * d[:, None, :]
    axes = np.linalg.svd(up_map[None])[2][1:] / sigma_rad
    for _ in range(STEPS):
        X = (P - T.t) @ T.R
        variance = (angle * np.linalg.norm(X - c, axis=1)) ** 2 * share + fixed2
        r = np.einsum("nij,nj->ni", Q, X - c)
        J = np.concatenate([Q @ np.array([skew(x) for x in X]), -Q @ T.R.T], axis=2)
        weight = share / variance
        up = T.R.T @ np.array([0.0, 0.0, 1.0])
        J_up = axes @ skew(up)
        H = np.einsum("nia,n,nib->ab", J, weight, J) + np.pad(J_up.T @ J_up, (0, 3))
        g = np.einsum("nia,n,ni->a", J, weight, r) + np.pad(J_up.T @ (axes @ up), (0, 3))
        step = np.asarray(np.linalg.solve(H + 1e-12 * np.eye(6), -g), np.float64)
        T = SE3.from_matrix(T.perturbed(step).matrix)
    chi2 = float(np.sum(weight * (r**2).sum(axis=1)) + np.sum((axes @ up) ** 2))
    worse = max(1.0, chi2 / max(2.0 * len(rows) - 4.0, 1.0))
    covariance = np.asarray(worse * np.linalg.inv(H), np.float64)
    if not np.isfinite(covariance).all():
        return None
    return Laid(T, covariance, tuple(names[k] for k in rows))
