"""A corridor around a block, a loop of 88 m. Its south side is bare: plain paint, plain floor, no picture for 18 m."""

from __future__ import annotations

import numpy as np

from lodelight.sim import prints
from lodelight.sim.builder import Builder
from lodelight.sim.furniture import bookcase, cabinet, cartons, plant

LENGTH, WIDTH, WAY = 32.2, 16.2, 2.2
BARE = (8.0, 26.0)  # of the south side, m
MID = WAY / 2
HEIGHT = 2.7
ROUTE = np.array([[5.0, MID], [LENGTH - MID, MID], [LENGTH - MID, WIDTH - MID], [MID, WIDTH - MID], [MID, MID]])


def build(b: Builder) -> None:
    x0, x1 = BARE
    inner_x, inner_y = LENGTH - WAY, WIDTH - WAY
    for a, e, floor, ceiling in (
        (0, x0, "terrazzo", "ceiling"),
        (x0, x1, "vinyl", "paint"),
        (x1, LENGTH, "terrazzo", "ceiling"),
    ):
        b.floor(a, 0, e, WAY, floor)
        b.ceiling(a, 0, e, WAY, ceiling)
    north = (0.0, inner_y, LENGTH, WIDTH)
    for area, floor in (
        (north, "carpet"),
        ((0.0, WAY, WAY, inner_y), "planks"),
        ((inner_x, WAY, LENGTH, inner_y), "planks"),
    ):
        b.floor(*area, floor)
        b.ceiling(*area, "ceiling")
    for a, e, skin in ((0, x0, "roughcast"), (x0, x1, "paint"), (x1, LENGTH, "white_brick")):
        b.wall((a, 0), (e, 0), skin, "brick")
    b.wall((LENGTH, 0), (LENGTH, WIDTH), "brick", "brick")
    b.wall((LENGTH, WIDTH), (0, WIDTH), "block", "brick")
    b.wall((0, WIDTH), (0, 0), "white_brick", "brick")
    for a, e, skin in ((WAY, x0, "block"), (x0, x1, "paint"), (x1, inner_x, "brick")):
        b.wall((a, WAY), (e, WAY), "brick", skin)
    b.wall((inner_x, WAY), (inner_x, inner_y), "brick", "slats")
    b.wall((inner_x, inner_y), (WAY, inner_y), "brick", "roughcast")
    b.wall((WAY, inner_y), (WAY, WAY), "brick", "pebbles")
    _things(b)
    _tags(b)
    for x in np.arange(1.1, LENGTH, 1.5):
        b.coded(x, MID, 2.7, b.next_frequency(), lumen=1100.0)
        b.coded(x, WIDTH - MID, 2.7, b.next_frequency(), lumen=1100.0)
    for y in np.arange(2.6, WIDTH - 2.0, 1.5):
        b.coded(MID, y, 2.7, b.next_frequency(), lumen=1100.0)
        b.coded(LENGTH - MID, y, 2.7, b.next_frequency(), lumen=1100.0)


def _things(b: Builder) -> None:
    """Doors, posters and furniture everywhere but along the bare stretch."""
    spots: list[tuple[float, float, float]] = []
    for x in np.arange(1.3, LENGTH - 1.0, 1.9):
        if not BARE[0] - 0.8 < x < BARE[1] + 0.8:
            spots += [(x, 0.06, 90)] + ([(x + 0.7, WAY - 0.06, -90)] if WAY < x < LENGTH - WAY - 1.0 else [])
        spots += [(x, WIDTH - 0.06, -90)] + (
            [(x + 0.6, WIDTH - WAY + 0.06, 90)] if WAY < x < LENGTH - WAY - 1.0 else []
        )
    for y in np.arange(2.9, WIDTH - 2.4, 1.9):
        spots += [(0.06, y, 0), (WAY - 0.06, y + 0.8, 180), (LENGTH - 0.06, y, 180), (LENGTH - WAY + 0.06, y + 0.8, 0)]
    for i, (x, y, yaw) in enumerate(spots):
        chance = b.random(f"spot {i}").random()
        rng = b.random(f"spot picture {i}", int(b.changed and chance < 0.6))
        if i % 3 == 0:
            b.decal(x, y, 1.05, yaw, (0.95, 2.1), prints.door(b.random(f"door {i}"), str(100 + i)))
        elif rng.random() < 0.75:
            b.decal(x, y, 1.55, yaw, (0.5, 0.8), prints.poster(rng))
        else:
            b.decal(x, y, 1.5, yaw, (1.0, 0.6), prints.board(rng, cork=bool(rng.random() < 0.6)))
    bookcase(b, LENGTH - 0.22, 4.6, -90)
    bookcase(b, LENGTH - 0.22, 5.8, -90)
    cabinet(b, 0.32, 9.0, 90, (1.2, 0.4, 1.0), "metal")
    cartons(b, 0.4, 12.4, 0, 3)
    plant(b, LENGTH - 0.4, 0.4)
    plant(b, 0.4, WIDTH - 0.4)
    plant(b, LENGTH - 0.4, WIDTH - 0.4, 1.6)
    for x in (6.0, 14.0, 22.0):
        cabinet(b, x, WIDTH - 0.3, 0, (1.0, 0.36, 1.1), "oak")


def _tags(b: Builder) -> None:
    places = [(3.2, 0.06, 90), (28.0, 0.06, 90), (LENGTH - 0.06, 8.2, 180), (LENGTH - 0.06, 13.2, 180)]
    places += [
        (26.0, WIDTH - 0.06, -90),
        (17.2, WIDTH - 0.06, -90),
        (9.4, WIDTH - 0.06, -90),
        (0.06, 11.4, 0),
        (0.06, 5.6, 0),
    ]
    for i, (x, y, yaw) in enumerate(places):
        b.tag("qr", i + 1, x, y, 1.15, yaw, surveyed=i % 3 == 2, size_m=0.3 if i % 3 == 2 else 0.2)
        dx, dy = (0.35, 0.0) if abs(yaw) == 90 else (0.0, 0.35)
        b.tag("tag36h11", i + 1, x + dx, y + dy, 1.15, yaw, size_m=0.16)
    ends = ((MID, WIDTH - 0.06, -90), (LENGTH - MID, WIDTH - 0.06, -90), (LENGTH - 0.06, MID, 180), (0.06, MID, 0))
    for i, (x, y, yaw) in enumerate(ends):
        b.tag("tag36h11", 30 + i, x, y, 1.5, yaw, size_m=0.24)
