"""One deck of a car park, 42 by 30 m: pillar after pillar, bay after bay, little light."""

from __future__ import annotations

import numpy as np

from lodelight.sim import prints
from lodelight.sim.builder import Builder

LENGTH, WIDTH, HEIGHT = 42.0, 30.0, 2.8
PILLARS_X = np.arange(6.0, LENGTH - 1.0, 5.0)
PILLARS_Y = (6.0, 12.0, 18.0, 24.0)
ROUTE = np.array([[5.0, 9.0], [36.5, 9.0], [38.5, 15.0], [36.5, 21.0], [5.0, 21.0], [3.4, 15.0]])


def build(b: Builder) -> None:
    b.floor(0, 0, LENGTH, WIDTH, "asphalt")
    b.ceiling(0, 0, LENGTH, WIDTH, "concrete")
    b.wall((0, 0), (LENGTH, 0), "block", "brick")
    b.wall((LENGTH, 0), (LENGTH, WIDTH), "roughcast", "brick")
    b.wall((LENGTH, WIDTH), (0, WIDTH), "block", "brick")
    b.wall((0, WIDTH), (0, 0), "brick", "brick")
    _pillars(b)
    _bays(b)
    for y in (9.0, 21.0):
        for x in np.arange(4.125, LENGTH - 2.0, 1.25):  # four pairs between two beams, in view from the lane
            for dy in (-0.45, 0.45):
                b.coded(x, y + dy, 2.75, b.next_frequency(), radius_m=0.12, lumen=550.0)
    for x in (3.4, 38.6):
        for y in (12.0, 15.0, 18.0):
            b.coded(x, y, 2.75, b.next_frequency(), radius_m=0.12, lumen=1100.0)
    for x in np.arange(4.0, LENGTH, 7.0):
        for y in (2.6, 15.0, 27.4):
            b.panel(x, y, 2.75, (1.2, 0.12), lumen=2200.0)


def _pillars(b: Builder) -> None:
    """Alike but for a number and, on some, a tag."""
    number = 0
    for j, y in enumerate(PILLARS_Y):
        for x in PILLARS_X:
            b.mesh.box((x, y, HEIGHT / 2), (0.5, 0.5, HEIGHT), "concrete", skip="tu")
            b.mesh.box((x, y, 0.6), (0.52, 0.52, 0.25), "laminate", skip="tu")
            faces = ((x, y - 0.25, -90), (x, y + 0.25, 90), (x - 0.25, y, 180), (x + 0.25, y, 0))
            for px, py, yaw in faces[:2]:
                b.decal(px, py, 2.0, yaw, (0.4, 0.2), prints.marking("ABCD"[j] + f"{number % 8 + 1}"))
            px, py, yaw = faces[number % 2]
            if number % 3 == 0:
                b.tag("qr", number + 1, px, py, 1.4, yaw, 0.25)
            else:
                b.tag("tag36h11", number, px, py, 1.4, yaw, 0.2)
            px, py, yaw = faces[2]
            b.tag("tag36h11", 100 + number, px, py, 1.4, yaw, 0.2)
            number += 1
    for y in (4.5, 14.4, 25.5):
        b.mesh.box((LENGTH / 2, y, 2.62), (LENGTH - 0.3, 0.16, 0.16), "metal", shade=1.3)
        b.mesh.box((LENGTH / 2, y + 0.3, 2.68), (LENGTH - 0.3, 0.08, 0.08), "metal", shade=0.7)
    for x in PILLARS_X:
        b.mesh.box((x, WIDTH / 2, 2.66), (0.4, WIDTH - 0.2, 0.28), "concrete", skip="t")


def _bays(b: Builder) -> None:
    """Painted bays along four rows, cars in two of three."""
    z, i = 0.004, 0
    for y0, y1, nose in ((0.4, 5.2, -90), (12.6, 14.9, 90), (15.1, 17.4, -90), (24.8, 29.6, 90)):
        for x in np.arange(6.0, 36.5, 2.5):
            b.mesh.quad((x - 0.05, y1, z), (0.1, 0, 0), (0, y0 - y1, 0), "laminate", shade=1.1)
            deep = y1 - y0
            if deep > 4.0:
                if b.random(f"bay {i}", int(b.changed)).random() < 0.66:
                    _car(b, x + 1.25, 0.5 * (y0 + y1), nose)
            elif i % 5 == 0:
                sign = b.shared(prints.label, i % 12)
                b.mesh.box((x + 1.25, 0.5 * (y0 + y1), 0.5), (0.8, 0.8, 1.0), "cardboard", faces={"f": sign, "b": sign})
            i += 1
    for x in np.arange(8.0, 36.0, 6.0):
        for y in (9.0, 21.0):
            text = b.picture(prints.marking("EXIT >" if y < 15 else "< OUT"))
            b.mesh.quad((x - 0.8, y + 0.35, z), (1.6, 0, 0), (0, -0.7, 0), text, fills=True)


def _car(b: Builder, x: float, y: float, yaw_deg: float) -> None:
    """Body, cabin with dark windows, wheels, number plates."""
    with b.movable(x, y, 0.0, yaw_deg) as rng:
        shade = float(rng.uniform(0.5, 1.3))
        b.mesh.box((0, 0, 0.58), (4.2, 1.75, 0.62), "metal", shade=shade)
        b.mesh.box((-0.2, 0, 1.15), (2.2, 1.5, 0.52), "metal", shade=0.25)
        b.mesh.box((-0.2, 0, 1.43), (1.9, 1.45, 0.06), "metal", shade=shade)
        for sx in (-1.3, 1.3):
            for sy in (-0.8, 0.8):
                b.mesh.box((sx, sy, 0.3), (0.6, 0.2, 0.6), "asphalt", shade=0.5)
        plate = b.shared(prints.label, int(rng.integers(12)))
        for sx, yaw in ((2.105, 0), (-2.105, 180)):
            b.mesh.box((sx, 0, 0.45), (0.02, 0.5, 0.12), "laminate", faces={"r" if yaw == 0 else "l": plate})
