"""A warehouse, 32 by 22 m and 7 m high: four pallet racks, three aisles with signs over them, packing areas."""

from __future__ import annotations

import numpy as np

from lodelight.sim import prints
from lodelight.sim.builder import Builder
from lodelight.sim.furniture import cabinet, cartons, desk, rack, table

LENGTH, WIDTH, HEIGHT = 32.0, 22.0, 7.0
RACKS_Y = (4.0, 8.8, 13.6, 18.4)
ROUTE = np.array(
    [[3.2, 6.4], [9.0, 6.4], [24.0, 6.4], [28.6, 6.6], [28.6, 11.0], [24.0, 11.2], [9.0, 11.2], [3.4, 11.0]]
)


def build(b: Builder) -> None:
    b.floor(0, 0, LENGTH, WIDTH, "concrete")
    b.ceiling(0, 0, LENGTH, WIDTH, "corrugated")
    b.wall((0, 0), (LENGTH, 0), "corrugated", "brick")
    b.wall((LENGTH, 0), (LENGTH, WIDTH), "brick", "brick")
    b.wall((LENGTH, WIDTH), (0, WIDTH), "corrugated", "brick")
    b.wall((0, WIDTH), (0, 0), "white_brick", "brick")
    for y in RACKS_Y:
        rack(b, 15.5, y, 0, 19.2, 3, 1.75, 1.2)
    _packing(b)
    _beams(b)
    _markings(b)
    _signs_and_tags(b)
    _aisle_signs(b)
    for x in np.arange(2.6, LENGTH - 2.0, 3.35):
        for y in (2.2, 6.4, 11.2, 16.0, 20.0):
            b.coded(x, y, 6.4, b.next_frequency(), radius_m=0.2, lumen=11000.0)


def _packing(b: Builder) -> None:
    """What stands along the walls of both ends."""
    for k, y in enumerate((1.5, 4.4, 8.2, 12.4, 15.0, 18.0, 20.6)):
        cartons(b, 0.9, y, 0, 3 + k % 2, side=0.7)
        cartons(b, 30.9, y + 0.5, 0, 2 + (k + 1) % 3, side=0.8)
        cartons(b, 30.0, y - 0.4, 0, 2 + k % 3, side=0.6)
    desk(b, 1.2, 6.2, 90, partition=True)
    desk(b, 1.2, 10.2, 90, partition=True)
    table(b, 30.6, 8.6, 90, (2.2, 0.9, 0.9))
    cabinet(b, 31.6, 14.4, -90, (1.8, 0.6, 2.2), "metal")
    cabinet(b, 0.45, 13.8, 90, (1.8, 0.6, 2.2), "metal")


def _beams(b: Builder) -> None:
    for x in np.arange(2.0, LENGTH, 4.0):
        b.mesh.box((x + 1.75, WIDTH / 2, 6.75), (0.2, WIDTH - 0.2, 0.35), "metal", shade=1.4)
    for y in (0.12, WIDTH - 0.12):
        for x in np.arange(2.0, LENGTH, 4.0):
            b.mesh.box((x + 1.75, y, 3.4), (0.25, 0.2, 6.8), "metal", shade=1.4)


def _markings(b: Builder) -> None:
    """Painted lines along the aisles, arrows and bay numbers on the floor."""
    z = 0.004
    for y in (5.0, 7.8, 9.8, 12.6, 14.6, 17.4):
        b.mesh.quad((5.5, y + 0.05, z), (20.0, 0, 0), (0, -0.1, 0), "laminate", shade=1.1)
    for x in (4.9, 26.1):
        b.mesh.quad((x - 0.05, 20.0, z), (0.1, 0, 0), (0, -18.0, 0), "laminate", shade=1.1)
    for i, x in enumerate(np.arange(6.5, 26.0, 2.4)):
        for j, y in enumerate((6.4, 11.2, 16.0)):
            sign = b.picture(prints.marking("ABC"[j] + f"{i + 1:02d}"))
            b.mesh.quad((x - 0.4, y + 0.2, z), (0.8, 0, 0), (0, -0.4, 0), sign, fills=True)


def _signs_and_tags(b: Builder) -> None:
    number = 1
    for j, y in enumerate(RACKS_Y):
        for x, yaw in ((5.82, 180), (25.18, 0)):
            b.mesh.box((x + (0.05 if yaw == 180 else -0.05), y, 1.6), (0.06, 0.9, 1.1), "laminate")
            face = x + (0.02 if yaw == 180 else -0.02)
            b.decal(face, y + 0.1, 2.0, yaw, (0.6, 0.3), prints.marking(f"RACK {j + 1}"))
            b.tag("qr", number, face, y - 0.22, 1.55, yaw, 0.25)
            b.tag("tag36h11", number, face, y + 0.22, 1.55, yaw, 0.2)
            number += 1
    for x in (8.0, 12.8, 17.6, 22.4):
        for y, yaw in (
            (RACKS_Y[0] + 0.63, 90),
            (RACKS_Y[1] - 0.63, -90),
            (RACKS_Y[1] + 0.63, 90),
            (RACKS_Y[2] - 0.63, -90),
        ):
            b.tag("tag36h11", 20 + number, x, y, 1.8, yaw, 0.12)
            number += 1
    walls = ((0.06, 3.0, 0), (0.06, 7.9, 0), (0.06, 16.5, 0), (31.94, 3.6, 180), (31.94, 11.4, 180), (31.94, 17.0, 180))
    for i, (x, y, yaw) in enumerate(walls):
        rng = b.random(f"poster {i}", int(b.changed))
        b.decal(x, y, 2.6, yaw, (1.0, 1.6), prints.poster(rng))
        b.tag("qr", 40 + i, x, y + 0.95, 1.9, yaw, 0.3, surveyed=True)


def _aisle_signs(b: Builder) -> None:
    """Boards that hang from every other beam over the aisles, with a tag on either side to be read from afar."""
    number = 60
    for j, y in enumerate((6.4, 11.2, 16.0)):
        for x in (7.75, 15.75, 23.75):
            b.mesh.box((x, y, 2.6), (0.04, 1.1, 0.5), "laminate")
            for side in (-0.45, 0.45):
                b.mesh.box((x, y + side, 4.72), (0.02, 0.02, 3.74), "metal")
            for face, yaw in ((x - 0.02, 180), (x + 0.02, 0)):
                left = 0.26 if yaw == 180 else -0.26
                b.decal(face, y + left, 2.6, yaw, (0.4, 0.4), prints.marking("ABC"[j]))
                b.tag("tag36h11", number, face, y - left, 2.6, yaw, 0.3)
                number += 1
