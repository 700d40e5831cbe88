"""Where a building is free: distances to its surfaces, and whether a way runs through one of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import label
from scipy.spatial import cKDTree

from lodelight.errors import ConfigError
from lodelight.geometry.se3 import SE3
from lodelight.sim.builder import Building
from lodelight.sim.bvh import STACK, cast_ray
from lodelight.sim.motion import Motion
from lodelight.sim.scene import Scene
from lodelight.types import Array

SPACING_M = 0.1  # of the points that stand for the surfaces
KEEP_M = 0.12  # of a body from anything: its cameras reach that far
ROOM_M = 0.25  # sought when placing a trajectory
STEP_S = 0.05


@dataclass(frozen=True, eq=False)
class Space:
    """Surfaces of a building as a cloud of points, and the tree of its quads."""

    building: Building
    _cloud: cKDTree = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_cloud", cKDTree(_surface_points(self.building.scene)))

    def clearance(self, points: Array) -> Array:
        """(N,) m to the nearest surface of (N, 3) m, to SPACING_M / sqrt(2)."""
        out: Array = np.asarray(self._cloud.query(points)[0])
        return out

    def blocked(self, a: Array, b: Array) -> str:
        """The surface between two points, or ''."""
        reach = float(np.linalg.norm(b - a))
        if reach < 1e-9:
            return ""
        _, quad = self._cast(a, (b - a) / reach, reach)
        return "" if quad < 0 else self.building.scene.names[quad]

    def indoors(self, point: Array) -> bool:
        """Whether there is something below and above."""
        down, up = np.array([1e-6, 1e-6, -1.0]), np.array([1e-6, 1e-6, 1.0])
        return all(self._cast(point, d, 1e3)[1] >= 0 for d in (down, up))

    def _cast(self, origin: Array, direction: Array, reach: float) -> tuple[float, int]:
        tree, stack = self.building.scene.tree, np.empty(STACK, np.int32)
        g = self.building.scene.geometry
        return cast_ray(tree.boxes, tree.links, tree.order, g, stack, origin, direction, reach, False)

    def check(self, motion: Motion) -> None:
        """Raises ConfigError, with time, place and surface, where a motion runs through something or outside."""
        t = np.arange(0.0, motion.duration_s, STEP_S)
        xyz = motion.at(t).xyz
        far = self.clearance(xyz)
        for i in range(len(t)):
            where = f"at {t[i]:.2f} s, ({xyz[i, 0]:.2f}, {xyz[i, 1]:.2f}, {xyz[i, 2]:.2f}) m"
            through = self.blocked(xyz[i - 1], xyz[i]) if i else ""
            if through:
                raise ConfigError(f"the trajectory runs through a surface ({through}) {where}; give --place or another")
            if not self.indoors(xyz[i]):
                raise ConfigError(f"the trajectory is outside the building {where}; give --place or another")
            if far[i] < KEEP_M - 0.5 * SPACING_M:
                raise ConfigError(
                    f"the trajectory passes {far[i]:.2f} m from a surface {where}; give --place or another"
                )

    def place(self, motion: Motion) -> SE3:
        """T_new_old that turns about the vertical and shifts a motion to where it has most room.

        Raises ConfigError where it fits nowhere.
        """
        t = np.linspace(0.0, motion.duration_s, max(50, min(1500, int(10 * motion.duration_s))))
        xyz = motion.at(t).xyz
        lo, hi = self.building.scene.tree.boxes[0, :3], self.building.scene.tree.boxes[0, 3:]
        field_, origin, pitch = self._distance_field(lo, hi)
        heights = _heights(xyz[:, 2], lo[2], hi[2])
        best, best_room = SE3.identity(), 0.0
        for turn in np.arange(0.0, 360.0, 15.0):
            a = math.radians(turn)
            R = np.array([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
            turned = xyz @ R.T
            low, high = turned.min(axis=0), turned.max(axis=0)
            for z in heights:
                for x in np.arange(lo[0] - low[0], hi[0] - high[0], 0.2):
                    for y in np.arange(lo[1] - low[1], hi[1] - high[1], 0.2):
                        shift = np.array([x, y, z])
                        room = _least(field_, turned, shift - origin, pitch, best_room)
                        if room > best_room:
                            best, best_room = SE3(R, shift), room
        if best_room < ROOM_M:
            size = ", ".join(f"{v:.1f}" for v in np.ptp(xyz, axis=0))
            raise ConfigError(
                f"the trajectory, {size} m across, fits nowhere in this building; choose another scenario"
            )
        return best

    def _distance_field(self, lo: Array, hi: Array) -> tuple[Array, Array, float]:
        pitch = 0.15
        axes = [np.arange(lo[k], hi[k] + pitch, pitch) for k in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        room = self.clearance(points.reshape(-1, 3)).reshape(points.shape[:3])
        # Of what is free only that counts which the route leads to, not the inside of a wall or the world outside
        part, _ = label(room > KEEP_M)
        start = np.array([*self.building.route[0], lo[2] + 0.5 * self.building.height_m])
        here = part[tuple(np.rint((start - lo) / pitch).astype(int))]
        return np.where(part == here, room, 0.0), lo, pitch


def _surface_points(scene: Scene) -> Array:
    parts = []
    for g in scene.geometry[: scene.static]:
        u, v = g[12:15], g[15:18]
        nu, nv = (max(2, math.ceil(float(np.linalg.norm(e)) / SPACING_M) + 1) for e in (u, v))
        a, b = np.meshgrid(np.linspace(0, 1, nu), np.linspace(0, 1, nv))
        parts.append(g[:3] + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v)
    return np.concatenate(parts)


def _heights(z: Array, floor: float, ceiling: float) -> list[float]:
    """Shifts along z to try: none if the motion fits as it is, else several that keep it inside."""
    if z.min() > floor + ROOM_M and z.max() < ceiling - ROOM_M:
        return [0.0]
    room = (ceiling - floor) - float(np.ptp(z)) - 2 * ROOM_M
    return [floor + ROOM_M - float(z.min()) + k * room for k in (0.25, 0.5, 0.75)] if room > 0 else []


def _least(distances: Array, points: Array, shift: Array, pitch: float, enough: float) -> float:
    """Smallest distance over shifted points; stops at a few of them where these are already too near."""
    size = np.array(distances.shape) - 1
    for part in (points[::25], points):
        index = np.rint((part + shift) / pitch).astype(int)
        if (index < 0).any() or (index > size).any():
            return 0.0
        least = float(distances[index[:, 0], index[:, 1], index[:, 2]].min())
        if least <= enough:
            return least
    return least
