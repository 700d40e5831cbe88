"""Where a map lies in the world, from pairs of one moment's pose by the lights and in the map.

Tilt comes from the fixes' own level alone: a path on a floor says nothing of it, and a fit of all six degrees of
freedom to its points would tip gravity over. Yaw and translation come from both. A map that an IMU levelled keeps its
own tilt. Source: science note A7, G13.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3, level
from lodelight.geometry.so3 import skew, so3_exp, so3_log
from lodelight.types import Array, Bools

SIGMA_M, SIGMA_RAD = 0.03, math.radians(0.5)  # of one fix (science note A6)
AGREE_M, AGREE_RAD = 0.10, math.radians(3.0)
ARM_RAD = math.radians(1.0)  # by which one fix may be turned: so much times the distance is forgiven at first
TRIED = 40  # pairs that are taken for a start
STEPS = 5


@dataclass(frozen=True, eq=False)
class Pair:
    """T_world_body by the lights, and T_map_body in the map, at one time."""

    T_world_body: SE3
    T_map_body: SE3


@dataclass(frozen=True, eq=False)
class Alignment:
    """T_world_map, and which pairs agree with it."""

    T_world_map: SE3
    agrees: Bools

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.agrees))


def align(pairs: Sequence[Pair], upright: bool = False) -> Alignment:
    """The alignment that most pairs agree with, each pair taken for a start in turn, then least squares over those.

    upright : up is up in the map, by an IMU, so that only a turn about z and a shift are asked for
    """
    rows = np.unique(np.linspace(0, len(pairs) - 1, min(TRIED, len(pairs))).round().astype(int)).tolist()
    starts = [pairs[i].T_world_body @ pairs[i].T_map_body.inverse() for i in rows]
    if upright:
        starts = [level(start, pairs[i].T_map_body.t) for i, start in zip(rows, starts, strict=True)]
    scored = [agreement(pairs, start, pairs[i].T_map_body.t) for i, start in zip(rows, starts, strict=True)]
    best = int(np.argmax([np.count_nonzero(s) for s in scored]))
    T, agrees = starts[best], scored[best]
    for _ in range(3):
        T = _refined(T, [pair for pair, yes in zip(pairs, agrees, strict=True) if yes], upright)
        again = agreement(pairs, T)
        if not again.any() or (again == agrees).all():
            break
        agrees = again
    return Alignment(T, agreement(pairs, T))


def agreement(pairs: Sequence[Pair], T_world_map: SE3, pivot: Array | None = None) -> Bools:
    """(N,) which pairs agree; with a pivot (3,), a point of the map, more is forgiven the farther they are from it."""
    R_light, p_light = np.array([q.T_world_body.R for q in pairs]), np.array([q.T_world_body.t for q in pairs])
    R_map, p_map = np.array([q.T_map_body.R for q in pairs]), np.array([q.T_map_body.t for q in pairs])
    arm_m = 0.0 if pivot is None else ARM_RAD * np.linalg.norm(p_map - pivot, axis=1)
    off_m = np.linalg.norm(T_world_map @ p_map - p_light, axis=1)
    apart = np.linalg.norm(T_world_map.R @ R_map - R_light, axis=(1, 2))  # 2 sqrt(2) sin(angle / 2)
    out: Bools = (off_m < AGREE_M + arm_m) & (apart < 2.0 * math.sqrt(2.0) * math.sin(0.5 * AGREE_RAD))
    return out


def _refined(T: SE3, pairs: Sequence[Pair], upright: bool) -> SE3:
    """Gauss-Newton over a turn about world axes, or z alone, and a translation."""
    free = np.arange(2 if upright else 0, 6)
    for _ in range(STEPS):
        H, g = np.zeros((6, 6)), np.zeros(6)
        for pair in pairs:
            there = T @ pair.T_map_body
            turn = there.R @ so3_log(np.ascontiguousarray(pair.T_world_body.R.T @ there.R))  # world axes
            J = np.zeros((6, 6))
            J[:3, :3] = np.eye(3) / SIGMA_RAD
            J[3:, 2] = -skew(T.R @ pair.T_map_body.t)[:, 2] / SIGMA_M
            J[3:, 3:] = np.eye(3) / SIGMA_M
            r = np.concatenate([turn / SIGMA_RAD, (there.t - pair.T_world_body.t) / SIGMA_M])
            H += J.T @ J
            g += J.T @ r
        step = np.zeros(6)
        step[free] = -np.linalg.solve(H[np.ix_(free, free)] + 1e-9 * np.eye(len(free)), g[free])
        T = SE3(so3_exp(np.ascontiguousarray(step[:3])) @ T.R, T.t + step[3:])
    return SE3.from_matrix(T.matrix)
