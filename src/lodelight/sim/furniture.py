"""Things that stand in rooms. Each is built in its own frame: x to its right, y to its back, z up, on the floor."""

from __future__ import annotations

import numpy as np

from lodelight.sim import prints
from lodelight.sim.builder import Builder

STOCK = 48  # different cartons in a building


def table(b: Builder, x: float, y: float, yaw_deg: float, size: tuple[float, float, float], top: str = "oak") -> None:
    """size : width, depth, height m."""
    w, d, h = size
    with b.movable(x, y, 0.0, yaw_deg) as rng:
        b.mesh.box((0, 0, h - 0.02), (w, d, 0.04), top)
        for sx in (-1, 1):
            for sy in (-1, 1):
                b.mesh.box((sx * (w / 2 - 0.05), sy * (d / 2 - 0.05), h / 2 - 0.02), (0.05, 0.05, h - 0.04), "metal")
        for _ in range(int(rng.integers(2, 6))):
            _sheet(b, rng, w, d, h)


def _sheet(b: Builder, rng: np.random.Generator, w: float, d: float, h: float) -> None:
    """Paper, a book or a small carton somewhere on a table top."""
    px, py = rng.uniform(-w / 2 + 0.15, w / 2 - 0.15), rng.uniform(-d / 2 + 0.15, d / 2 - 0.15)
    kind = rng.random()
    with b.mesh.at(px, py, h, rng.uniform(0, 360)):
        if kind < 0.55:
            name = b.shared(prints.papers, int(rng.integers(STOCK)))
            b.mesh.quad((-0.1, 0.15, 0.004), (0.21, 0, 0), (0, -0.297, 0), name, fills=True)
        elif kind < 0.8:
            cover = b.picture(prints.poster(rng))
            b.mesh.box((0, 0, 0.02), (0.15, 0.22, 0.04), "laminate", faces={"t": cover}, skip="u")
        else:
            b.mesh.box(
                (0, 0, 0.08),
                (0.2, 0.14, 0.16),
                "cardboard",
                faces={"f": b.shared(prints.label, int(rng.integers(STOCK)))},
            )


def desk(b: Builder, x: float, y: float, yaw_deg: float, partition: bool = True) -> None:
    """A work place: top, drawers, screen, keyboard, papers, and a fabric partition behind it."""
    with b.movable(x, y, 0.0, yaw_deg) as rng:
        b.mesh.box((0, 0, 0.72), (1.5, 0.75, 0.04), "oak")
        b.mesh.box((-0.72, 0, 0.35), (0.04, 0.7, 0.7), "laminate")
        b.mesh.box((0.52, 0.02, 0.35), (0.4, 0.65, 0.66), "metal")
        for k in range(3):
            b.mesh.box((0.52, -0.315, 0.15 + 0.22 * k), (0.12, 0.02, 0.02), "laminate")
        if partition:
            b.mesh.box((0, 0.4, 0.62), (1.55, 0.05, 1.24), "fabric")
            for _ in range(int(rng.integers(1, 4))):
                note = b.shared(prints.papers, int(rng.integers(STOCK)))
                px, pz = rng.uniform(-0.6, 0.5), rng.uniform(0.95, 1.15)
                b.mesh.quad((px, 0.37, pz + 0.1), (0.15, 0, 0), (0, 0, -0.2), note, fills=True)
        px = rng.uniform(-0.25, 0.15)
        with b.mesh.at(px, 0.16, 0.74, rng.uniform(-15, 15)):
            b.mesh.box((0, 0, 0.01), (0.22, 0.18, 0.02), "metal")
            b.mesh.box((0, 0.03, 0.1), (0.05, 0.03, 0.2), "metal")
            face = b.picture(prints.screen(rng))
            b.mesh.box((0, 0, 0.31), (0.54, 0.04, 0.33), "metal", faces={"f": face})
        keys = b.shared(prints.keyboard, 0)
        b.mesh.box((px, -0.15, 0.75), (0.42, 0.14, 0.02), "metal", faces={"t": keys}, skip="u")
        for _ in range(int(rng.integers(1, 4))):
            _sheet(b, rng, 1.4, 0.6, 0.74)


def chair(b: Builder, x: float, y: float, yaw_deg: float) -> None:
    """A swivel chair that looks to -y."""
    with b.movable(x, y, 0.0, yaw_deg) as rng, b.mesh.at(0, 0, 0, rng.uniform(-40, 40)):
        b.mesh.box((0, 0, 0.46), (0.46, 0.46, 0.08), "fabric")
        b.mesh.box((0, 0.22, 0.78), (0.42, 0.06, 0.5), "fabric", shade=0.8)
        b.mesh.box((0, 0, 0.24), (0.06, 0.06, 0.36), "metal")
        b.mesh.box((0, 0, 0.05), (0.6, 0.06, 0.05), "metal")
        b.mesh.box((0, 0, 0.05), (0.06, 0.6, 0.05), "metal")


def bookcase(b: Builder, x: float, y: float, yaw_deg: float, width: float = 1.0, boards: int = 5) -> None:
    """Shelves full of books, 0.36 m a board."""
    pitch, deep = 0.36, 0.3
    with b.movable(x, y, 0.0, yaw_deg) as rng:
        height = boards * pitch + 0.05
        for s in (-1, 1):
            b.mesh.box((s * (width / 2 - 0.015), 0, height / 2), (0.03, deep, height), "oak")
        b.mesh.quad((-width / 2, deep / 2 - 0.01, height), (width, 0, 0), (0, 0, -height), "oak", shade=0.7)
        for k in range(boards + 1):
            b.mesh.box((0, 0, 0.03 + k * pitch), (width - 0.06, deep, 0.03), "oak")
        for k in range(boards):
            books = b.picture(prints.spines(rng))
            inset = rng.uniform(0.0, 0.06)
            face = (-width / 2 + 0.03, -deep / 2 + 0.02 + inset, 0.045 + k * pitch + 0.32)
            b.mesh.quad(face, (width - 0.06, 0, 0), (0, 0, -0.32), books, fills=True)


def cabinet(b: Builder, x: float, y: float, yaw_deg: float, size: tuple[float, float, float], skin: str) -> None:
    """A closed cupboard with two doors and something on top."""
    w, d, h = size
    with b.movable(x, y, 0.0, yaw_deg) as rng:
        b.mesh.box((0, 0, h / 2), (w, d, h), skin)
        for s in (-1, 1):
            b.mesh.box((s * w / 4, -d / 2 - 0.008, h / 2), (w / 2 - 0.02, 0.016, h - 0.06), skin, shade=0.95)
            b.mesh.box((s * 0.04, -d / 2 - 0.03, h * 0.6), (0.015, 0.02, 0.14), "metal")
        for _ in range(int(rng.integers(0, 4))):
            carton_at(b, rng, float(rng.uniform(-w / 2 + 0.2, w / 2 - 0.2)), 0.0, h, 0.3)


def carton_at(b: Builder, rng: np.random.Generator, x: float, y: float, z: float, side: float) -> None:
    """A carton with labels, `side` m or so."""
    w, d, h = side * rng.uniform(0.8, 1.3), side * rng.uniform(0.7, 1.0), side * rng.uniform(0.6, 1.1)
    faces = {side: b.shared(prints.label, int(rng.integers(STOCK))) for side in "flrb"[: int(rng.integers(1, 4))]}
    with b.mesh.at(x, y, z, float(rng.uniform(-12, 12))):
        b.mesh.box((0, 0, h / 2), (w, d, h), "cardboard", faces=faces, skip="u", shade=float(rng.uniform(0.8, 1.15)))


def cartons(b: Builder, x: float, y: float, yaw_deg: float, count: int, side: float = 0.45) -> None:
    """A stack on the floor."""
    with b.movable(x, y, 0.0, yaw_deg) as rng:
        z = 0.0
        for _ in range(count):
            w, d, h = side * rng.uniform(0.8, 1.2), side * rng.uniform(0.8, 1.1), side * rng.uniform(0.6, 1.0)
            faces = {s: b.shared(prints.label, int(rng.integers(STOCK))) for s in "fr"}
            with b.mesh.at(float(rng.uniform(-0.05, 0.05)), float(rng.uniform(-0.05, 0.05)), z, rng.uniform(-10, 10)):
                b.mesh.box((0, 0, h / 2), (w, d, h), "cardboard", faces=faces)
            z += h


def plant(b: Builder, x: float, y: float, height: float = 1.3) -> None:
    """A pot with leaves."""
    with b.movable(x, y, 0.0, 0.0) as rng:
        b.mesh.box((0, 0, 0.17), (0.32, 0.32, 0.34), "concrete", shade=0.8)
        for _ in range(26):
            with b.mesh.at(0, 0, 0, float(rng.uniform(0, 360))):
                r, z = rng.uniform(0.03, 0.3), rng.uniform(0.4, height)
                droop, wide = rng.uniform(-0.12, 0.12), rng.uniform(0.05, 0.1)
                b.mesh.quad(
                    (r, wide / 2, z), (0.22, 0, droop), (0, -wide, 0), "fabric", shade=float(rng.uniform(0.5, 1.1))
                )


def sofa(b: Builder, x: float, y: float, yaw_deg: float) -> None:
    """Looks to -y."""
    with b.movable(x, y, 0.0, yaw_deg):
        b.mesh.box((0, 0, 0.22), (1.7, 0.8, 0.36), "fabric", shade=1.2)
        b.mesh.box((0, 0.32, 0.6), (1.7, 0.18, 0.44), "fabric", shade=1.2)
        for s in (-1, 1):
            b.mesh.box((s * 0.8, 0, 0.4), (0.16, 0.8, 0.5), "fabric", shade=1.1)


def rack(b: Builder, x: float, y: float, yaw_deg: float, length: float, levels: int, pitch: float, deep: float) -> None:
    """A pallet rack: posts, beams, and cartons on every level, seen from both sides."""
    with b.movable(x, y, 0.0, yaw_deg, bolted=True) as rng:
        bays = max(1, round(length / 2.4))
        bay = length / bays
        height = levels * pitch + 0.3
        for k in range(bays + 1):
            for s in (-1, 1):
                b.mesh.box((k * bay - length / 2, s * (deep / 2 - 0.04), height / 2), (0.08, 0.08, height), "metal")
        for level in range(levels):
            z = 0.15 + level * pitch
            for s in (-1, 1):
                b.mesh.box((0, s * (deep / 2 - 0.03), z - 0.06), (length, 0.05, 0.1), "metal", shade=1.5)
            b.mesh.box((0, 0, z - 0.005), (length, deep - 0.1, 0.02), "planks", skip="fblr")
            at = -length / 2 + 0.1
            while at < length / 2 - 0.5:
                w = float(rng.uniform(0.4, 1.1))
                if at + w > length / 2 - 0.08:
                    break
                if rng.random() < 0.88:
                    h = float(rng.uniform(0.35, pitch - 0.3))
                    shade, d = float(rng.uniform(0.7, 1.25)), float(rng.uniform(0.75, 0.98)) * (deep - 0.15)
                    faces = (
                        {s: b.shared(prints.label, int(rng.integers(STOCK))) for s in "fb"}
                        if rng.random() < 0.7
                        else None
                    )
                    b.mesh.box(
                        (at + w / 2, 0, z + h / 2), (w - 0.04, d, h), "cardboard", faces=faces, skip="u", shade=shade
                    )
                at += w
