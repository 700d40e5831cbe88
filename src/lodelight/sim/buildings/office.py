"""An office floor, 20 by 14 m: open plan, meeting room, kitchen, store and library along a corridor."""

from __future__ import annotations

import numpy as np

from lodelight.sim import prints
from lodelight.sim.builder import Builder
from lodelight.sim.furniture import bookcase, cabinet, cartons, chair, desk, plant, sofa, table

HEIGHT = 3.0
DOOR = (0.0, 2.1)  # bottom and top of a door's opening, m
ROUTE = np.array(
    [
        [6.0, 4.1], [3.0, 4.1], [3.0, 6.6], [3.0, 9.0], [6.0, 9.05], [13.0, 8.95], [17.0, 9.0], [17.0, 11.2],
        [14.2, 12.0], [14.2, 11.0], [16.4, 10.6], [17.0, 9.0], [17.0, 6.6], [15.9, 6.2], [13.9, 5.2], [13.6, 2.6],
        [11.0, 2.5], [8.2, 2.5], [8.0, 4.1],
    ]
)  # fmt: skip


def build(b: Builder) -> None:
    _shell(b)
    _open_plan(b)
    _meeting_room(b)
    _north_rooms(b)
    _pictures(b)
    _tags(b)
    _lamps(b)


def _shell(b: Builder) -> None:
    b.floor(0, 0, 12, 8, "carpet")
    b.floor(12, 0, 20, 8, "planks")
    b.floor(0, 8, 20, 10, "terrazzo")
    b.floor(0, 10, 7, 14, "tiles")
    b.floor(7, 10, 12, 14, "concrete")
    b.floor(12, 10, 20, 14, "dark_planks")
    b.ceiling(0, 0, 20, 14, "ceiling")
    sills = tuple((x, x + 1.6, 0.9, 2.5) for x in (1.2, 4.2, 7.2, 10.0, 13.4, 16.6))
    b.wall((0, 0), (20, 0), "roughcast", "roughcast", sills)
    for x0, x1, *_ in sills:
        b.window(0.5 * (x0 + x1), -0.05, 1.7, 90, (x1 - x0, 1.6), 420.0)
    b.wall((20, 0), (20, 14), "brick", "brick")
    b.wall((20, 14), (0, 14), "mosaic", "roughcast")
    b.wall((0, 14), (0, 0), "white_brick", "brick")
    b.wall((0, 8), (12, 8), "pebbles", "white_brick", ((2.4, 3.6, *DOOR), (9.4, 10.6, *DOOR)))
    b.wall((12, 8), (20, 8), "roughcast", "slats", ((4.4, 5.6, *DOOR),))
    b.wall((12, 0), (12, 8), "mosaic", "roughcast", ((1.9, 3.1, *DOOR),))
    b.wall((20, 10), (12, 10), "brick", "white_brick", ((2.4, 3.6, *DOOR),))
    b.wall((12, 10), (7, 10), "slats", "block", ((2.0, 3.0, *DOOR),))
    b.wall((7, 10), (0, 10), "mosaic", "tiles", ((3.3, 4.5, *DOOR),))
    b.wall((7, 10), (7, 14), "tiles", "block")
    b.wall((12, 10), (12, 14), "pebbles", "white_brick")


def _open_plan(b: Builder) -> None:
    for row, y in enumerate((0.85, 5.7)):
        for k, x in enumerate((5.2, 6.9, 8.6)):
            if row == 0:
                desk(b, x, y, 180)
                chair(b, x, y + 0.75, 180)
            else:
                desk(b, x, y, 180)
                chair(b, x, y - 0.8 + 1.6, 180)
                desk(b, x, y - 0.82, 0, partition=False) if k != 1 else None
    desk(b, 0.85, 2.0, 90)
    desk(b, 0.85, 4.2, 90)
    chair(b, 1.7, 2.0, 90)
    for x in (5.2, 6.3, 7.4):
        bookcase(b, x, 7.76, 0)
    cabinet(b, 0.9, 7.62, 0, (1.2, 0.5, 1.3), "metal")
    bookcase(b, 11.78, 5.0, -90)
    bookcase(b, 11.78, 6.1, -90)
    plant(b, 11.5, 0.6)
    plant(b, 0.5, 0.6, 1.6)
    cartons(b, 1.1, 6.4, 0, 2)
    cartons(b, 11.3, 7.4, 0, 3)
    table(b, 10.3, 5.6, 90, (1.4, 0.8, 0.74))


def _meeting_room(b: Builder) -> None:
    table(b, 17.2, 3.0, 90, (2.8, 1.2, 0.75))
    for y in (2.0, 3.0, 4.0):
        chair(b, 16.2, y, 90)
        chair(b, 18.2, y, -90)
    cabinet(b, 19.62, 1.4, -90, (1.6, 0.5, 0.9), "laminate")
    bookcase(b, 19.78, 5.5, -90)
    bookcase(b, 19.78, 6.6, -90)
    sofa(b, 13.3, 7.35, 0)
    plant(b, 19.4, 7.5)
    plant(b, 12.5, 0.5)
    b.decal(19.94, 3.4, 1.6, 180, (2.4, 1.2), prints.board(b.random("board", int(b.changed)), cork=False))


def _north_rooms(b: Builder) -> None:
    for x in (12.8, 13.9, 15.0, 16.1, 17.2, 18.3, 19.3):
        bookcase(b, x, 13.76, 0)
    for y in (11.0, 12.1, 13.0):
        bookcase(b, 12.25, y, 90)
    table(b, 18.4, 12.2, 0, (1.4, 0.8, 0.74))
    bookcase(b, 19.78, 11.0, -90)
    cabinet(b, 1.5, 13.62, 0, (2.6, 0.6, 0.9), "laminate")
    cabinet(b, 4.2, 13.62, 0, (1.0, 0.6, 2.0), "metal")
    table(b, 4.6, 12.0, 0, (1.6, 0.8, 0.74))
    chair(b, 4.2, 11.3, 180)
    chair(b, 5.0, 12.7, 0)
    for k, (x, y) in enumerate(((7.6, 13.5), (8.3, 13.5), (9.4, 13.4), (11.5, 13.4), (11.5, 11.0), (7.6, 12.0))):
        cartons(b, x, y, 0, 2 + k % 3)
    plant(b, 19.6, 8.4, 1.2)
    cabinet(b, 9.9, 8.32, 180, (0.9, 0.4, 1.1), "metal") if False else None
    plant(b, 0.4, 9.6)


def _pictures(b: Builder) -> None:
    """Posters and boards; those of a changed building are other ones."""
    spots = [
        *((x, 8.06, 90) for x in (1.2, 4.6, 6.0, 7.4, 8.6, 11.4, 13.2, 15.2, 18.6)),
        *((x, 9.94, -90) for x in (1.2, 4.9, 6.2, 8.2, 10.8, 13.2, 14.6, 18.6, 19.5)),
        *((0.06, y, 0) for y in (1.4, 3.0, 5.2, 9.0, 11.0, 12.5)),
        *((x, 7.94, -90) for x in (1.7, 4.2, 8.4, 13.0, 14.8, 18.8)),
        *((19.94, y, 180) for y in (9.0, 12.4)),
        *((11.94, y, 180) for y in (3.9, 1.0)),
        *((12.06, y, 0) for y in (1.0, 3.9, 5.0, 6.4)),
        *((x, 10.06, 90) for x in (1.0, 5.6, 13.2, 18.4)),
    ]  # fmt: skip
    for i, (x, y, yaw) in enumerate(spots):
        rng = b.random(f"poster {i}", int(b.changed))
        kind = rng.random()
        z = float(rng.uniform(1.45, 1.7))
        if kind < 0.6:
            b.decal(x, y, z, yaw, (0.5, 0.8), prints.poster(rng))
        elif kind < 0.8:
            b.decal(x, y, z, yaw, (0.8, 0.5), prints.poster(rng, portrait=False))
        else:
            b.decal(x, y, z, yaw, (1.0, 0.6), prints.board(rng, cork=True))
    for x, y, yaw, text in ((2.05, 8.06, 90, "101"), (16.0, 8.06, 90, "103"), (17.9, 9.94, -90, "105")):
        b.decal(x, y, 1.6, yaw, (0.24, 0.12), prints.marking(text))


def _tags(b: Builder) -> None:
    qr = (
        (0.06, 4.1, 1.4, 0), (5.35, 8.06, 1.4, 90), (12.2, 9.94, 1.4, -90), (19.94, 2.0, 1.4, 180),
        (12.06, 4.45, 1.4, 0), (9.0, 7.94, 1.5, -90), (19.94, 9.5, 1.4, 180), (19.94, 12.9, 1.5, 180),
        (6.94, 12.0, 1.4, 180), (3.3, 0.06, 1.4, 90),
    )  # fmt: skip
    for i, (x, y, z, yaw) in enumerate(qr):
        b.tag("qr", i + 1, x, y, z, yaw)
    surveyed = ((0.06, 9.5, 1.5, 0), (11.94, 4.4, 1.5, 180), (16.4, 13.94, 2.2, -90))
    for i, (x, y, z, yaw) in enumerate(surveyed):
        b.tag("qr", 21 + i, x, y, z, yaw, size_m=0.3, surveyed=True)
    april = (
        (3.9, 8.06, 90), (10.0 - 0.9, 8.06, 90), (14.4, 8.06, 90), (7.4, 9.94, -90), (15.5, 9.94, -90), (0.06, 2.2, 0),
        (0.06, 6.2, 0), (11.94, 1.5, 180), (12.06, 3.4, 0), (12.06, 7.2, 0), (15.8, 7.94, -90), (19.94, 4.9, 180),
        (13.4, 10.06, 90), (15.0, 10.06, 90), (4.0, 7.94, -90),
    )  # fmt: skip
    for i, (x, y, yaw) in enumerate(april):
        b.tag("tag36h11", i, x, y, 1.15, yaw, size_m=0.16)


def _lamps(b: Builder) -> None:
    for x in (2.0, 6.0, 10.0):
        for y in (2.0, 6.0):
            b.panel(x, y, 3.0, (1.2, 0.3))
    for x in (14.0, 18.0):
        for y in (2.2, 5.8):
            b.panel(x, y, 3.0, (1.2, 0.3))
    for x, y in ((3.5, 12.0), (9.5, 12.0), (14.0, 12.0), (18.0, 12.0)):
        b.panel(x, y, 3.0, (0.6, 0.6))
    places = [(x, y) for y in (0.8, 2.4, 4.0, 5.6, 7.2) for x in (0.9, 2.6, 4.3, 6.0, 7.7, 9.4, 11.1)]
    places += [
        (x, y)
        for x in (0.8, 2.2, 3.6, 5.0, 6.4, 7.8, 9.2, 10.6, 12.0, 13.4, 14.8, 16.2, 17.6, 19.0)
        for y in (8.6, 9.4)
    ]
    places += [(x, y) for x in (13.0, 14.8, 16.6, 18.4) for y in (0.9, 3.0, 4.9, 7.1)]
    places += [(x, y) for x in (13.2, 15.0, 17.0, 19.0) for y in (11.0, 12.9)]
    places += [(x, y) for x in (1.4, 3.4, 5.4, 8.2, 10.6) for y in (11.0, 13.0)]
    places = [
        p
        for p in places
        if all(abs(p[0] - lamp.center[0]) > 0.8 or abs(p[1] - lamp.center[1]) > 0.4 for lamp in b.lamps)
    ]
    for x, y in places:
        b.coded(x, y, 3.0, b.next_frequency())
