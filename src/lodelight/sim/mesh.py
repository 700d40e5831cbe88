"""Geometry of a building: textured rectangles, collected object by object, handed over as arrays.

Every quad is seen from both sides. Its origin is the upper left corner as one reads it, `u` runs right and `v` down,
so pictures hang upright and `v x u` points at the reader.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.types import Array


@dataclass(frozen=True, eq=False)
class Quad:
    """origin, u, v (3,) m world. `surface` names a material, or a picture that fills the quad where `fills` is set.

    shade : factor on the material's reflectance; shift : (2,) m, where on the material the quad lies
    lamp : index of the light whose luminous face this is, or -1
    """

    origin: Array
    u: Array
    v: Array
    surface: str
    fills: bool = False
    shade: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    lamp: int = -1


@dataclass(eq=False)
class Mesh:
    """Collects quads in the local frame that `at` has set."""

    rng: np.random.Generator
    quads: list[Quad] = field(default_factory=list)
    _frames: list[SE3] = field(default_factory=lambda: [SE3.identity()])

    @property
    def frame(self) -> SE3:
        """T_world_local of what is being built."""
        return self._frames[-1]

    @contextmanager
    def at(self, x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0) -> Iterator[SE3]:
        """Build in a frame at (x, y, z) m of the current one, turned about z."""
        a = math.radians(yaw_deg)
        R = np.array([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
        self._frames.append(self.frame @ SE3(R, np.array([x, y, z], dtype=np.float64)))
        try:
            yield self.frame
        finally:
            self._frames.pop()

    def quad(
        self,
        origin: tuple[float, float, float],
        u: tuple[float, float, float],
        v: tuple[float, float, float],
        surface: str,
        fills: bool = False,
        shade: float = 1.0,
        lamp: int = -1,
        shift: tuple[float, float] | None = None,
    ) -> None:
        """One rectangle in the local frame; `shift` None lays the material anywhere."""
        T = self.frame
        if shift is None:
            shift = (float(self.rng.uniform(0, 16)), float(self.rng.uniform(0, 16)))
        self.quads.append(
            Quad(T @ np.array(origin), T.R @ np.array(u), T.R @ np.array(v), surface, fills, shade, shift, lamp)
        )

    def box(
        self,
        center: tuple[float, float, float],
        size: tuple[float, float, float],
        surface: str,
        *,
        faces: dict[str, str] | None = None,
        skip: str = "",
        shade: float = 1.0,
    ) -> None:
        """An upright box. `faces` gives single sides a picture of their own, `skip` leaves sides out; by their
        letters: f front (-y), b back (+y), l left (-x), r right (+x), t top, u underside."""
        (cx, cy, cz), (sx, sy, sz) = center, size
        x0, x1, y0, y1, z0, z1 = cx - sx / 2, cx + sx / 2, cy - sy / 2, cy + sy / 2, cz - sz / 2, cz + sz / 2
        down = (0.0, 0.0, -sz)
        sides = {
            "f": ((x0, y0, z1), (sx, 0.0, 0.0), down),
            "b": ((x1, y1, z1), (-sx, 0.0, 0.0), down),
            "l": ((x0, y1, z1), (0.0, -sy, 0.0), down),
            "r": ((x1, y0, z1), (0.0, sy, 0.0), down),
            "t": ((x0, y1, z1), (sx, 0.0, 0.0), (0.0, -sy, 0.0)),
            "u": ((x0, y0, z0), (sx, 0.0, 0.0), (0.0, sy, 0.0)),
        }
        pictures = faces or {}
        for side, (origin, u, v) in sides.items():
            if side not in skip:
                self.quad(origin, u, v, pictures.get(side, surface), fills=side in pictures, shade=shade)
