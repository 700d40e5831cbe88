"""Boxes the size of people that walk along a building's route, both ways."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.sim.bvh import geometry_table
from lodelight.sim.mesh import Mesh, Quad
from lodelight.types import Array

ASIDE_M = 0.35  # they keep this far to the side of the route


@dataclass(frozen=True, eq=False)
class Crowd:
    """`count` people; positions are a function of time, so images can be made in any order."""

    route: Array
    count: int
    seed: int
    quads: list[Quad] = field(init=False)
    _start: Array = field(init=False)
    _speed: Array = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 77])
        object.__setattr__(self, "_start", rng.uniform(0.0, 1.0, self.count))
        way = np.where(rng.random(self.count) < 0.5, -1.0, 1.0)
        object.__setattr__(self, "_speed", way * rng.uniform(0.7, 1.3, self.count))
        object.__setattr__(self, "quads", [q for k in range(self.count) for q in self._person(k, 0.0)])

    def geometry(self, t_s: float) -> Array:
        """Rows of the geometry table for all quads at a time, (n, 18)."""
        quads = [q for k in range(self.count) for q in self._person(k, t_s)]
        return geometry_table(*(np.array([getattr(q, part) for q in quads]) for part in ("origin", "u", "v")))

    def _person(self, k: int, t_s: float) -> list[Quad]:
        mesh = Mesh(np.random.default_rng([self.seed, 78, k]))
        T = self._stand(k, t_s)
        with mesh.at(T.t[0], T.t[1], 0.0, math.degrees(math.atan2(T.R[1, 0], T.R[0, 0]))):
            swing = 0.12 * math.sin(2 * math.pi * 0.9 * t_s + k)
            for s in (-1, 1):
                mesh.box((s * swing, s * 0.1, 0.42), (0.16, 0.15, 0.84), "asphalt", skip="tu")
            mesh.box((0.0, 0.0, 1.13), (0.26, 0.46, 0.62), "fabric", shade=0.6 + 0.5 * (k % 3))
            mesh.box((0.0, 0.0, 1.6), (0.2, 0.17, 0.25), "cork", skip="u")
        return mesh.quads

    def _stand(self, k: int, t_s: float) -> SE3:
        """T_world_person on the floor, x ahead."""
        closed = np.vstack([self.route, self.route[:1]])
        legs = np.linalg.norm(np.diff(closed, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(legs)])
        s = (self._start[k] * at[-1] + self._speed[k] * t_s) % at[-1]
        p, ahead = (np.array([np.interp(v % at[-1], at, closed[:, i]) for i in range(2)]) for v in (s, s + 0.3))
        yaw = math.atan2(ahead[1] - p[1], ahead[0] - p[0]) + (math.pi if self._speed[k] < 0 else 0.0)
        c, sn = math.cos(yaw), math.sin(yaw)
        R = np.array([[c, -sn, 0.0], [sn, c, 0.0], [0.0, 0.0, 1.0]])
        return SE3(R, np.array([p[0] + ASIDE_M * sn, p[1] - ASIDE_M * c, 0.0]))
