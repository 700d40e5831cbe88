"""A rectangle of four tunnels in rock, 100 m around, dim, with chambers at its corners."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lodelight.sim import prints
from lodelight.sim.builder import Builder
from lodelight.sim.furniture import cartons

LENGTH, WIDTH, ROOM = 36.0, 20.0, 5.0  # outer size and side of a chamber, m
PROFILE = ((2.0, 0.0), (2.0, 1.8), (1.4, 2.7), (0.5, 3.1))  # half of the cross-section: (half width, height)
PORTAL = (1.5, 2.3)  # half width and height of a chamber's doorway
MID = ROOM / 2
HEIGHT = 3.2
ROUTE = np.array([[MID, MID], [LENGTH - MID, MID], [LENGTH - MID, WIDTH - MID], [MID, WIDTH - MID]])


def build(b: Builder) -> None:
    corners = ((0, 0), (LENGTH - ROOM, 0), (LENGTH - ROOM, WIDTH - ROOM), (0, WIDTH - ROOM))
    for i, (x, y) in enumerate(corners):
        _chamber(b, x, y, i)
    sides: tuple[tuple[float, float, int, float], ...] = (
        (ROOM, MID, 0, LENGTH - 2 * ROOM),
        (LENGTH - MID, ROOM, 90, WIDTH - 2 * ROOM),
    )
    sides += ((LENGTH - ROOM, WIDTH - MID, 180, LENGTH - 2 * ROOM), (MID, WIDTH - ROOM, -90, WIDTH - 2 * ROOM))
    for i, (x, y, yaw, length) in enumerate(sides):
        with b.mesh.at(x, y, 0.0, yaw):
            _tube(b, length, i)


def _chamber(b: Builder, x: float, y: float, i: int) -> None:
    b.floor(x, y, x + ROOM, y + ROOM, "concrete")
    b.ceiling(x, y, x + ROOM, y + ROOM, "rock")
    door = ((MID - PORTAL[0], MID + PORTAL[0], 0.0, PORTAL[1]),)
    b.wall((x, y), (x + ROOM, y), "rock", "rock", _door(i, "s", door))
    b.wall((x + ROOM, y), (x + ROOM, y + ROOM), "rock", "rock", _door(i, "e", door))
    b.wall((x + ROOM, y + ROOM), (x, y + ROOM), "rock", "rock", _door(i, "n", door))
    b.wall((x, y + ROOM), (x, y), "rock", "rock", _door(i, "w", door))
    cx, cy = x + MID, y + MID
    for dx, dy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        b.coded(cx + 0.9 * dx, cy + 0.9 * dy, 3.1, b.next_frequency(), lumen=350.0)
    out = ((-1, -1), (1, -1), (1, 1), (-1, 1))[i]
    for k in range(3):
        cartons(b, cx + out[0] * (1.9 - 0.8 * (k == 1)), cy + out[1] * (1.9 - 0.8 * (k == 2)), 0, 2 + k % 2, side=0.6)
    wx, wy = (x + 0.06, x + ROOM - 0.06)[out[0] > 0], (y + 0.06, y + ROOM - 0.06)[out[1] > 0]
    b.tag("qr", 10 + i, wx, cy - 0.3 * out[1], 1.6, 0 if out[0] < 0 else 180, 0.3, surveyed=True)
    b.tag("tag36h11", 10 + i, cx - 0.3 * out[0], wy, 1.6, 90 if out[1] < 0 else -90, 0.24)
    rng = b.random(f"poster {i}", int(b.changed))
    b.decal(cx - 0.9 * out[0], wy, 1.7, 90 if out[1] < 0 else -90, (0.5, 0.8), prints.poster(rng))


def _door(
    i: int, side: str, door: tuple[tuple[float, float, float, float], ...]
) -> tuple[tuple[float, float, float, float], ...]:
    """Chamber 0 leads on to the east and north, 1 to the north and west, 2 west and south, 3 south and east."""
    return door if side in ("en", "nw", "ws", "se")[i] else ()


def _tube(b: Builder, length: float, i: int) -> None:
    """One tunnel along x: walls and vault in strips, cable tray, lamps, niches with a box and a tag."""
    b.floor(0, -2.0, length, 2.0, "asphalt")
    for s in (-1.0, 1.0):
        for (w0, z0), (w1, z1) in pairwise(PROFILE):
            skin = "concrete" if z0 == 0.0 else "rock"
            if s > 0:  # v runs down the strip; v x u points into the tunnel
                b.mesh.quad((0, w1, z1), (length, 0, 0), (0, w0 - w1, z0 - z1), skin)
            else:
                b.mesh.quad((length, -w1, z1), (-length, 0, 0), (0, w1 - w0, z0 - z1), skin)
    top = PROFILE[-1]
    b.mesh.quad((0, -top[0], top[1]), (length, 0, 0), (0, 2 * top[0], 0), "rock")
    for z, y in ((1.9, -1.9), (2.05, -1.85)):
        b.mesh.box((length / 2, y, z), (length, 0.12, 0.05), "metal", shade=0.8)
    for x in np.arange(2.0, length - 3.5, 6.0):
        b.mesh.box((x, 1.85, 1.2), (0.4, 0.3, 0.6), "metal", faces={"f": b.shared(prints.label, int(x) % 12)})
        b.mesh.box((x + 3.0, 0.0, 0.02), (0.1, 3.9, 0.04), "metal")
    for k, x in enumerate(np.arange(1.0, length, 4.0)):
        b.tag("tag36h11", 40 + 20 * i + k, x, -1.995, 1.35, 90, 0.16)
        b.decal(x + 1.0, -1.995, 1.4, 90, (0.5, 0.25), prints.marking(f"{i + 1}-{10 * k:03d} m"))
    for x in np.arange(0.8, length, 2.0):
        b.coded(x, 0.25 * (-1) ** int(x / 2), 3.1, b.next_frequency(), lumen=900.0)
