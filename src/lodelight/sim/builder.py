"""The hands that put a building together: walls with openings, pictures, tags, lamps, things that may be moved."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from lodelight.anchors import Anchors, Light, Tag
from lodelight.anchors.payload import tag_payload
from lodelight.geometry.se3 import SE3
from lodelight.sim import prints
from lodelight.sim.faults import Faults
from lodelight.sim.materials import MATERIALS, Material, make
from lodelight.sim.mesh import Mesh
from lodelight.sim.people import Crowd
from lodelight.sim.scene import Lamp, Scene, assemble
from lodelight.types import Array, ArrayF32

DECAL_GAP_M = 0.004  # nearer to its wall a picture would fight with it for the pixels
TAG_GAP_M = 0.008  # codes are stuck over pictures
MOVED_SHARE, MOVED_M, DARK_SHARE = 0.5, 0.35, 0.15  # what a `changed` building changes
FREQUENCIES_HZ = range(2000, 8001, 200)  # above flicker, below half of a phone camera's row rate (science note A1)
PANEL_LM, DISC_LM = 3600.0, 900.0


@dataclass(frozen=True, eq=False)
class Building:
    """A scene with what is surveyed in it and a way through it.

    route : (N, 2) m, closed polyline on the floor, clear of walls and furniture; height_m : under the ceiling
    """

    name: str
    scene: Scene
    anchors: Anchors
    route: Array
    height_m: float
    crowd: Crowd | None = None


@dataclass(eq=False)
class Builder:
    """Collects one building. The same seed gives the same building; `changed` moves furniture, replaces pictures
    and darkens lights, and leaves walls, tags and the light of every other lamp as they were."""

    name: str
    seed: int
    route: Array
    height_m: float
    changed: bool = False
    faults: Faults = field(default_factory=Faults)
    mesh: Mesh = field(init=False)
    pictures: dict[str, ArrayF32] = field(default_factory=dict)
    lamps: list[Lamp] = field(default_factory=list)
    tags: list[Tag] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    _items: int = 0
    _prints: dict[str, tuple[ArrayF32, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.mesh = Mesh(self.random("mesh"))

    def random(self, key: str, variant: int = 0) -> np.random.Generator:
        """A generator of its own for every key, so that adding a thing leaves all others as they were."""
        return np.random.default_rng([self.seed, zlib.crc32(f"{self.name}/{key}".encode()), variant])

    @contextmanager
    def movable(
        self, x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0, bolted: bool = False
    ) -> Iterator[np.random.Generator]:
        """Build a thing at (x, y, z), or beside it if the building has changed; yields what decides on its contents.

        bolted : to the floor, so that it stays where it is
        A changed building has other contents also in what has not moved, as goods and books are turned over.
        """
        self._items += 1
        chance = self.random(f"change {self._items}")
        moved = self.changed and not bolted and chance.random() < MOVED_SHARE
        if moved:
            x, y, yaw_deg = self._beside(x, y, yaw_deg, chance)
        own = self.random(f"item {self._items}", int(moved))
        rng = self.random(f"item {self._items}", 1) if self.changed and not moved else own
        before, self.mesh.rng = self.mesh.rng, own
        try:
            with self.mesh.at(x, y, z, yaw_deg):
                yield rng
        finally:
            self.mesh.rng = before

    def _beside(self, x: float, y: float, yaw_deg: float, rng: np.random.Generator) -> tuple[float, float, float]:
        """A place nearby that is no nearer to the route."""
        here = self._from_route(x, y)
        for _ in range(8):
            dx, dy = rng.uniform(-MOVED_M, MOVED_M, 2)
            if self._from_route(x + dx, y + dy) >= min(here, 1.2):
                return x + dx, y + dy, yaw_deg + rng.uniform(-12, 12)
        return x, y, yaw_deg

    def _from_route(self, x: float, y: float) -> float:
        T = self.mesh.frame
        p = (T @ np.array([x, y, 0.0]))[:2]
        a, b = self.route, np.roll(self.route, -1, axis=0)
        along = np.clip(((p - a) * (b - a)).sum(1) / np.maximum(((b - a) ** 2).sum(1), 1e-9), 0, 1)
        return float(np.linalg.norm(a + along[:, None] * (b - a) - p, axis=1).min())

    def picture(self, image: ArrayF32) -> str:
        """Keep a picture and return the name a quad refers to it by."""
        name = f"picture {len(self.pictures)}"
        self.pictures[name] = image
        return name

    def shared(self, kind: Callable[[np.random.Generator], ArrayF32], number: int) -> str:
        """One of a stock of pictures that many things carry, made when first asked for."""
        name = f"{kind.__name__} {number}"
        if name not in self.pictures:
            self.pictures[name] = kind(self.random(name))
        return name

    def decal(self, x: float, y: float, z: float, yaw_deg: float, size: tuple[float, float], image: ArrayF32) -> None:
        """A picture of (width, height) m on a wall, its middle at (x, y, z); yaw is where it faces."""
        a = math.radians(yaw_deg)
        right, out = np.array([-math.sin(a), math.cos(a)]), np.array([math.cos(a), math.sin(a)])
        p = np.array([x, y]) + DECAL_GAP_M * out - 0.5 * size[0] * right
        u = size[0] * right
        self.mesh.quad(
            (p[0], p[1], z + 0.5 * size[1]), (u[0], u[1], 0.0), (0.0, 0.0, -size[1]), self.picture(image), fills=True
        )

    def tag(
        self,
        family: str,
        number: int,
        x: float,
        y: float,
        z: float,
        yaw_deg: float,
        size_m: float = 0.2,
        surveyed: bool = False,
    ) -> None:
        """Hang a code with its middle at (x, y, z) m of the local frame, facing yaw.

        surveyed : a QR code that says itself where it hangs. Anchors know the place of every tag.
        """
        a = math.radians(yaw_deg)
        x, y = x + TAG_GAP_M * math.cos(a), y + TAG_GAP_M * math.sin(a)
        R = np.array([[-math.sin(a), 0, -math.cos(a)], [math.cos(a), 0, -math.sin(a)], [0.0, -1.0, 0.0]])
        T = self.mesh.frame @ SE3(R, np.array([x, y, z]))
        label = f"Q{number:02d}" if family == "qr" else str(number)
        tag = Tag(family, label, size_m, T)
        self.tags.append(tag)
        if family == "qr":
            image, margin = prints.qr(tag_payload(tag if surveyed else Tag(family, label, size_m)))
        else:
            image, margin = prints.fiducial(family, number)
        self._prints[label] = image, size_m * margin
        if label == self.faults.moved_tag:
            self._hang(label, T, 0.5)
        else:
            self._hang(label, T, 0.0)

    def _hang(self, label: str, T_world_tag: SE3, lower_m: float) -> None:
        """Put the print of a tag where a tag is, or `lower_m` below it."""
        side = self._prints[label][1]
        x, y = 0.5 * side * T_world_tag.R[:, 0], 0.5 * side * T_world_tag.R[:, 1]
        corner = T_world_tag.t - x - y + lower_m * T_world_tag.R[:, 1]
        with self.world():
            u, v = 2.0 * x, 2.0 * y
            self.mesh.quad(_triple(corner), _triple(u), _triple(v), self._code(label), fills=True)

    def _code(self, label: str) -> str:
        name = f"code {label}"
        self.pictures[name] = self._prints[label][0]
        return name

    def panel(self, x: float, y: float, z: float, size: tuple[float, float], lumen: float = PANEL_LM) -> None:
        """An office lamp that hums at twice the mains, flat under the ceiling."""
        luminance = lumen / (math.pi * size[0] * size[1])
        self._lamp(Lamp(self._under(x, y, z), np.array([0.0, 0.0, -1.0]), size, luminance))

    def next_frequency(self) -> float:
        """A frequency for the next coded light: all of the plan in a shuffled order, then all again in another.

        In another, so that two neighbours have no second pair of neighbours with their codes.
        """
        again = len(self.lights) // len(FREQUENCIES_HZ)
        order = self.random(f"frequencies {again}" if again else "frequencies").permutation(len(FREQUENCIES_HZ))
        return float(FREQUENCIES_HZ[order[len(self.lights) % len(order)]])

    def coded(
        self, x: float, y: float, z: float, frequency_hz: float, radius_m: float = 0.09, lumen: float = DISC_LM
    ) -> None:
        """A round light that blinks at its own frequency; `luminance` is its mean over a period."""
        label = f"L{len(self.lights) + 1:02d}"
        center = self._under(x, y, z)
        aside = np.array([1.0, 0.0, 0.0]) if label == self.faults.moved_light else np.zeros(3)
        self.lights.append(Light(label, frequency_hz, center + aside, radius_m=radius_m))
        if label == self.faults.light:  # it blinks as another light does; the survey does not know
            frequency_hz += 600.0 if frequency_hz < 7000.0 else -600.0
        phase = float(self.random(f"phase {label}").uniform())
        side = 4.0 * radius_m  # the face shows the wings of the bell beyond the rim
        luminance = lumen / (math.pi * math.pi * radius_m**2)
        lamp = Lamp(center, np.array([0.0, 0.0, -1.0]), (side, side), luminance, True, label, frequency_hz, 0.5, phase)
        self._lamp(lamp)

    def _under(self, x: float, y: float, z: float) -> Array:
        out: Array = self.mesh.frame @ np.array([x, y, z - DECAL_GAP_M])
        return out

    def _lamp(self, lamp: Lamp) -> None:
        index = len(self.lamps)
        if self.changed and self.random(f"dark {index}").random() < DARK_SHARE:
            lamp = replace(lamp, on=False)
        self.lamps.append(lamp)
        (w, h), c = lamp.size_m, lamp.center
        with self.world():
            origin = (c[0] - w / 2, c[1] - h / 2, c[2])
            self.mesh.quad(origin, (w, 0.0, 0.0), (0.0, h, 0.0), "lamp_face", fills=True, lamp=index)

    @contextmanager
    def world(self) -> Iterator[None]:
        """Build in world coordinates for a moment."""
        self.mesh._frames.append(SE3.identity())
        try:
            yield
        finally:
            self.mesh._frames.pop()

    def window(self, x: float, y: float, z: float, yaw_deg: float, size: tuple[float, float], nits: float) -> None:
        """A bright view outside, facing yaw; it lights the room."""
        a = math.radians(yaw_deg)
        out = np.array([math.cos(a), math.sin(a), 0.0])
        center = self.mesh.frame @ np.array([x, y, z]) + DECAL_GAP_M * (self.mesh.frame.R @ out)
        index = len(self.lamps)
        self.lamps.append(Lamp(center, self.mesh.frame.R @ out, size, nits))
        right = np.array([-math.sin(a), math.cos(a)])
        p = np.array([x, y]) + DECAL_GAP_M * out[:2] - 0.5 * size[0] * right
        view = self.picture(prints.outside(self.random(f"view {index}")))
        u = size[0] * right
        self.mesh.quad(
            (p[0], p[1], z + 0.5 * size[1]), (u[0], u[1], 0.0), (0.0, 0.0, -size[1]), view, fills=True, lamp=index
        )

    def wall(
        self,
        p: tuple[float, float],
        q: tuple[float, float],
        left: str,
        right: str,
        openings: tuple[tuple[float, float, float, float], ...] = (),
        thickness: float = 0.12,
        height: float | None = None,
    ) -> None:
        """An upright wall from p to q with a surface on either side.

        openings : (start, end) along the wall and (bottom, top) over the floor, m, in order and apart
        """
        length = math.dist(p, q)
        h = height or self.height_m
        yaw = math.degrees(math.atan2(q[1] - p[1], q[0] - p[0]))
        cuts = [0.0, *(v for o in openings for v in o[:2]), length]
        pieces = [(s, e, 0.0, h) for s, e in zip(cuts[::2], cuts[1::2], strict=True)]
        for s, e, bottom, top in openings:
            pieces += [(s, e, 0.0, bottom)] * (bottom > 0) + [(s, e, top, h)] * (top < h)
        base = self.mesh.rng.uniform(0, 16, 4)
        half = 0.5 * thickness
        with self.mesh.at(p[0], p[1], 0.0, yaw):
            for s, e, z0, z1 in pieces:
                if e - s < 1e-6:
                    continue
                down = (0.0, 0.0, z0 - z1)
                self.mesh.quad((s, -half, z1), (e - s, 0, 0), down, right, shift=(base[0] + s, base[1] - z1))
                self.mesh.quad((e, half, z1), (s - e, 0, 0), down, left, shift=(base[2] - e, base[3] - z1))
            for s, e, bottom, top in openings:
                rise, deep = (0.0, 0.0, bottom - top), 2 * half
                self.mesh.quad((s, -half, top), (0, deep, 0), rise, "laminate")
                self.mesh.quad((e, half, top), (0, -deep, 0), rise, "laminate")
                self.mesh.quad((s, -half, top), (e - s, 0, 0), (0, deep, 0), "laminate")
                if bottom > 0:
                    self.mesh.quad((s, half, bottom), (e - s, 0, 0), (0, -deep, 0), "laminate")
            for s, side in ((0.0, -1.0), (length, 1.0)):
                self.mesh.quad((s, -side * half, h), (0, side * 2 * half, 0), (0, 0, -h), left)

    def floor(self, x0: float, y0: float, x1: float, y1: float, surface: str, z: float = 0.0) -> None:
        self.mesh.quad((x0, y1, z), (x1 - x0, 0, 0), (0, y0 - y1, 0), surface)

    def ceiling(self, x0: float, y0: float, x1: float, y1: float, surface: str) -> None:
        self.mesh.quad((x0, y0, self.height_m), (x1 - x0, 0, 0), (0, y1 - y0, 0), surface)

    def finish(self) -> Building:
        """Pack everything; the light is not baked yet."""
        self.faults.check(self.name, {tag.id for tag in self.tags}, {light.id for light in self.lights})
        if self.faults.duplicated_tag:
            where = self.tags[-1].T_world_tag
            assert where is not None
            self._hang(self.faults.duplicated_tag, where, 0.4)
        self.lamps = self.faults.swapped(self.lamps)
        crowd = Crowd(self.route, self.faults.people, self.seed) if self.faults.people else None
        surfaces: dict[str, Material] = {name: Material(image) for name, image in self.pictures.items()}
        used = {q.surface for q in self.mesh.quads + (crowd.quads if crowd else [])} | {"stain"}
        surfaces |= {name: make(name, self.seed) for name in sorted(used) if name in MATERIALS}
        scene = assemble(self.mesh, surfaces, self.lamps, crowd.quads if crowd else None)
        anchors = Anchors(tuple(self.tags), tuple(self.lights))
        return Building(self.name, scene, anchors, self.route, self.height_m, crowd)


def _triple(v: Array) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
