"""Does every light hang where its survey says? Rays to it from a moving camera meet where it really is."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.se3 import SE3
from lodelight.lights.rays import meeting
from lodelight.types import Array

OFF_M = (
    0.3  # a light farther than this from its survey, across its rays, hangs elsewhere: along them a map's scale tells
)
NEAR_M = 0.15  # one nearer than this is where it should be
WITNESSES, RECENT_S = 2, 3.0  # other lights, seen lately, that must be in their places: else it is the map that is not
COMPANY = 0.5  # of a light's error: one seen beside it that is off by the same, to within that share, blames the map
KEPT = 40  # rays that are remembered


@dataclass(frozen=True, eq=False)
class Misplaced:
    """A light that hangs elsewhere. xyz (3,) m, world: where; other : the light that is surveyed there, or \"\".

    alike : those that have its code as well, one of which it may be
    """

    light: Light
    xyz: Array
    other: str
    alike: tuple[str, ...] = ()

    @property
    def off_m(self) -> float:
        return float(np.linalg.norm(self.xyz - self.light.xyz))

    @property
    def why(self) -> str:
        where = f"where {self.other} should hang" if self.other else "not where it was surveyed"
        at = ", ".join(f"{v:.2f}" for v in self.xyz)
        alike = f" (or {', '.join(self.alike)}, of its code)" if self.alike else ""
        return f"light {self.light.id}{alike} hangs at {at}, {self.off_m:.2f} m from its survey, {where}"


class LightWatch:
    """Fed with sightings from poses that are known otherwise."""

    def __init__(self, lights: dict[str, Light]) -> None:
        self._lights = lights
        self._rays: dict[str, deque[tuple[int, Array, Array]]] = {}
        self._suspects: set[str] = set()
        self.misplaced: dict[str, Misplaced] = {}

    def forget(self) -> None:
        """The poses so far were in another frame."""
        self._rays.clear()
        self._suspects.clear()
        self.misplaced.clear()

    def see(self, t_ns: int, name: str, T_world_cam: SE3, ray_cam: Array) -> list[Misplaced]:
        """One sighting; the lights that prove by it to hang elsewhere, each told once: this one, or one seen lately."""
        rays = self._rays.setdefault(name, deque(maxlen=KEPT))
        direction = T_world_cam.R @ ray_cam
        rays.append((t_ns, T_world_cam.t, direction / np.linalg.norm(direction)))
        self._suspects.add(name)
        found = []
        for suspect in sorted(self._suspects - self.misplaced.keys()):
            xyz = self._place(suspect)
            if xyz is None or self._across_m(suspect, xyz) < OFF_M or self._ago_s(suspect, t_ns) > RECENT_S:
                self._suspects.discard(suspect)
            elif self._convicted(suspect, xyz):
                self.misplaced[suspect] = self._named(self._lights[suspect], xyz)
                found.append(self.misplaced[suspect])
        return found

    def _named(self, light: Light, xyz: Array) -> Misplaced:
        others = [o for o in self._lights.values() if o.id != light.id]
        there = [o.id for o in others if np.linalg.norm(o.xyz - xyz) < OFF_M]
        alike = tuple(o.id for o in others if (o.frequency_hz, o.word) == (light.frequency_hz, light.word))
        return Misplaced(light, xyz, there[0] if there else "", alike)

    def _ago_s(self, name: str, t_ns: int) -> float:
        return abs(t_ns - self._rays[name][-1][0]) * 1e-9

    def _place(self, name: str, since_ns: int | None = None) -> Array | None:
        """(3,) where a light's rays meet, or None."""
        rays = [(c, d) for t_ns, c, d in self._rays[name] if since_ns is None or t_ns >= since_ns]
        return meeting(np.array([c for c, _ in rays]), np.array([d for _, d in rays]))

    def _across_m(self, name: str, xyz: Array) -> float:
        """How far a place is from the light's survey, across the mean ray."""
        mean = np.sum([d for _, _, d in self._rays[name]], axis=0)
        off = xyz - self._lights[name].xyz
        return float(np.linalg.norm(off - (off @ mean) / (mean @ mean) * mean))

    def _convicted(self, name: str, xyz: Array) -> bool:
        """Whether the light is to blame, and not the map, or a moment's bad tracking, which move its neighbours too.

        Others must have been in their places lately; and of those that were seen beside it one at least must be found,
        and none be off by the same.
        """
        off = xyz - self._lights[name].xyz
        since_ns, now_ns = self._rays[name][0][0], self._rays[name][-1][0]
        witnesses = beside = 0
        for other in self._rays:
            if other == name or self._ago_s(other, now_ns) > RECENT_S:
                continue
            survey, place = self._lights[other].xyz, self._place(other)
            witnesses += place is not None and bool(np.linalg.norm(place - survey) < NEAR_M)
            place = self._place(other, since_ns)
            if place is not None and np.linalg.norm(place - survey - off) < COMPANY * np.linalg.norm(off):
                return False
            beside += place is not None
        return witnesses >= WITNESSES and beside > 0
