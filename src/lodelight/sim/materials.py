"""Procedural surfaces: reflectance pictures that tile without a seam, with structure at every scale.

Real walls carry grain of a millimetre, blotches of a hand and shades of a metre at once; a surface that lacks one of
them looks painted and starves corner detectors at some distance. Each material here is a pattern (bricks, planks,
tiles) on top of fractal noise that spans the whole range.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lodelight.types import Array, ArrayF32

SIZE = 1024  # px of a tiling picture


@dataclass(frozen=True, eq=False)
class Material:
    """picture : (h, w) float32 reflectance in [0, 1]; tile_m : what its width covers; stain : weight of the stains
    laid over it, as a part of its own reflectance"""

    picture: ArrayF32
    tile_m: float = 2.0
    stain: float = 0.0


def fractal(rng: np.random.Generator, slope: float, low: float, high: float, stretch: float = 1.0) -> Array:
    """(SIZE, SIZE) noise of mean 0 and deviation 1 that tiles: amplitude ~ f^-slope from `low` to `high` periods per
    side; `stretch` > 1 draws it out along x. Slope 1 has the same contrast in every octave."""
    fy = np.fft.fftfreq(SIZE, 1.0 / SIZE)[:, None]
    fx = np.fft.rfftfreq(SIZE, 1.0 / SIZE)[None, :] * stretch
    f = np.hypot(fx, fy)
    amplitude = np.where((f >= low) & (f <= high), np.maximum(f, 1.0) ** -slope, 0.0)
    spectrum = amplitude * np.exp(2j * np.pi * rng.random(f.shape))
    noise: Array = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    noise = (noise - noise.mean()) / noise.std()
    return noise


def relief(height: Array, strength: float) -> Array:
    """Shading of a height field lit from the upper left, mean 0."""
    lit: Array = strength * (height - np.roll(height, (1, 1), (0, 1)))
    return lit


def specks(rng: np.random.Generator, share: float, radius_px: tuple[float, float], squash: float = 0.6) -> Array:
    """(SIZE, SIZE) mask of random ellipses that cover about `share` of the area, tiling; values in [0, 1]."""
    mean_area = np.pi * np.mean(np.square(radius_px)) * squash
    count = int(share * SIZE * SIZE / mean_area)
    out = np.zeros((SIZE, SIZE))
    reach = int(np.ceil(radius_px[1])) + 2
    yy, xx = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    center, radius = rng.integers(0, SIZE, (count, 2)), rng.uniform(*radius_px, count)
    angle, strength = rng.uniform(0, np.pi, count), rng.uniform(0.5, 1.0, count)
    for (cy, cx), r, a, s in zip(center, radius, angle, strength, strict=True):
        e, f = np.cos(a) * xx + np.sin(a) * yy, (np.cos(a) * yy - np.sin(a) * xx) / squash
        blob = s * np.clip(r - np.hypot(e, f) + 0.5, 0.0, 1.0)
        rows, cols = (cy + np.arange(-reach, reach + 1)) % SIZE, (cx + np.arange(-reach, reach + 1)) % SIZE
        at = np.ix_(rows, cols)
        out[at] = np.maximum(out[at], blob)
    return out


def bond(
    rng: np.random.Generator, rows: int, columns: int, offset: float, joint_px: float, wobble: float
) -> tuple[Array, Array]:
    """A masonry pattern: (cell values in [0, 1], distance to the nearest joint, 0 in the joint and 1 from
    `joint_px` on), each (SIZE, SIZE). Every other row is shifted by `offset` cells; `wobble` px bends the joints."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    if wobble:
        x, y = x + wobble * fractal(rng, 1.0, 4, 60), y + wobble * fractal(rng, 1.0, 4, 60)
    h, w = SIZE / rows, SIZE / columns
    row = np.floor(y / h)
    shifted = x / w + offset * (row % 2)
    column = np.floor(shifted)
    gap_y, gap_x = (y / h - row) * h, (shifted - column) * w
    gap = np.minimum(np.minimum(gap_y, h - gap_y), np.minimum(gap_x, w - gap_x))
    values = rng.random((rows, columns))
    cells: Array = values[row.astype(int) % rows, column.astype(int) % columns]
    return cells, np.clip((gap - 0.5 * joint_px) / max(1.0, 0.4 * joint_px), 0.0, 1.0)


def _material(value: Array, tile_m: float, stain: float) -> Material:
    return Material(np.clip(value, 0.02, 0.98).astype(np.float32), tile_m, stain)


def stain(rng: np.random.Generator) -> Material:
    """Shades and blotches from decimetres to metres, mean 0.5."""
    return _material(0.5 + 0.17 * fractal(rng, 1.1, 2, 160), 7.3, 0.0)


def brick(rng: np.random.Generator, body: float = 0.36, joint: float = 0.6) -> Material:
    cells, inside = bond(rng, 24, 8, 0.5, 5.0, 1.6)
    grain = fractal(rng, 0.7, 20, 500)
    face = body * (0.65 + 0.7 * cells) * (1.0 + 0.22 * grain + 0.12 * fractal(rng, 1.0, 3, 60))
    face *= 1.0 - 0.7 * specks(rng, 0.03, (1.0, 3.5))
    mortar = joint * (1.0 + 0.12 * fractal(rng, 0.6, 60, 500))
    return _material(mortar + (face - mortar) * inside + relief(inside + 0.15 * grain, 0.10), 1.8, 0.5)


def block(rng: np.random.Generator) -> Material:
    """Painted concrete blocks."""
    cells, inside = bond(rng, 10, 5, 0.5, 5.0, 0.8)
    pores = specks(rng, 0.05, (0.8, 2.6))
    face = 0.62 * (0.92 + 0.16 * cells) * (1.0 + 0.05 * fractal(rng, 0.8, 10, 500)) * (1.0 - 0.5 * pores)
    return _material(0.45 + (face - 0.45) * inside + relief(inside, 0.12), 2.0, 0.5)


def roughcast(rng: np.random.Generator) -> Material:
    """Coarse plaster: grain of some millimetres lit from the side."""
    height = fractal(rng, 0.5, 60, 330)
    return _material(0.6 + relief(height, 0.085) + 0.035 * fractal(rng, 1.0, 3, 200), 1.6, 0.45)


def paint(rng: np.random.Generator) -> Material:
    """A rolled wall, nearly without texture."""
    return _material(0.66 * (1.0 + 0.012 * fractal(rng, 0.6, 40, 400)), 2.0, 0.10)


def concrete(rng: np.random.Generator) -> Material:
    value = 0.42 * (1.0 + 0.16 * fractal(rng, 1.0, 2, 500))
    return _material(value * (1.0 - 0.75 * specks(rng, 0.025, (1.0, 5.0), 0.8)), 2.2, 0.6)


def asphalt(rng: np.random.Generator) -> Material:
    stones = specks(rng, 0.30, (1.5, 4.0))
    return _material(0.17 * (1.0 + 0.25 * fractal(rng, 0.8, 3, 500)) + 0.22 * stones, 1.5, 0.6)


def terrazzo(rng: np.random.Generator) -> Material:
    cells, inside = bond(rng, 4, 4, 0.0, 3.0, 0.0)
    chips = 0.35 * specks(rng, 0.22, (2.0, 7.0)) - 0.30 * specks(rng, 0.18, (1.5, 6.0))
    face = (0.5 + chips) * (0.92 + 0.16 * cells) * (1.0 + 0.05 * fractal(rng, 1.0, 3, 300))
    return _material(0.25 + (face - 0.25) * inside, 1.6, 0.4)


def tiles(rng: np.random.Generator) -> Material:
    """Glazed wall tiles with a pale pattern."""
    cells, inside = bond(rng, 10, 10, 0.0, 4.0, 0.0)
    face = 0.7 * (0.8 + 0.3 * cells) * (1.0 + 0.08 * fractal(rng, 1.0, 4, 400))
    return _material(0.35 + (face - 0.35) * inside + relief(inside, 0.08), 1.5, 0.3)


def carpet(rng: np.random.Generator) -> Material:
    cells, inside = bond(rng, 4, 4, 0.0, 2.0, 0.0)
    flecks = 0.32 * specks(rng, 0.16, (1.5, 5.0), 0.4) - 0.14 * specks(rng, 0.2, (1.5, 6.0), 0.4)
    face = (0.26 + flecks) * (0.85 + 0.3 * cells) * (1.0 + 0.22 * fractal(rng, 0.3, 100, 500))
    return _material(face * (0.8 + 0.2 * inside), 2.0, 0.5)


def ceiling(rng: np.random.Generator) -> Material:
    """Mineral fibre tiles of 0.6 m with pinholes and fissures in their frame."""
    _, inside = bond(rng, 3, 3, 0.0, 12.0, 0.0)
    holes = np.maximum(specks(rng, 0.035, (0.9, 2.4), 1.0), specks(rng, 0.05, (2.0, 8.0), 0.25))
    face = 0.72 * (1.0 + 0.03 * fractal(rng, 0.8, 5, 300)) * (1.0 - 0.62 * holes)
    return _material(0.85 + (face - 0.85) * inside + relief(inside, 0.1), 1.8, 0.25)


def planks(rng: np.random.Generator, shade: float = 0.42) -> Material:
    """A wooden floor, planks along x."""
    cells, inside = bond(rng, 12, 2, 0.37, 2.0, 0.0)
    grain = fractal(rng, 0.8, 4, 500, stretch=14.0)
    shift = np.roll(grain, SIZE // 3, axis=1)
    face = shade * (0.7 + 0.6 * cells) * (1.0 + 0.22 * np.where(cells > 0.5, grain, shift))
    face *= 1.0 - 0.7 * specks(rng, 0.006, (2.0, 9.0), 0.5)
    return _material(0.08 + (face - 0.08) * inside, 1.8, 0.35)


def oak(rng: np.random.Generator) -> Material:
    """Veneer of furniture."""
    grain = fractal(rng, 0.8, 2, 500, stretch=10.0)
    return _material(0.38 * (1.0 + 0.2 * grain) * (1.0 - 0.5 * specks(rng, 0.004, (2.0, 7.0), 0.5)), 1.2, 0.3)


def laminate(rng: np.random.Generator) -> Material:
    """White board with scratches and dust."""
    scratches = fractal(rng, 0.5, 30, 400, stretch=0.15)
    return _material(0.72 * (1.0 + 0.03 * scratches) * (1.0 - 0.35 * specks(rng, 0.004, (0.8, 3.0))), 1.5, 0.35)


def metal(rng: np.random.Generator) -> Material:
    brushed = fractal(rng, 0.5, 10, 500, stretch=20.0)
    return _material(0.34 * (1.0 + 0.07 * brushed) * (1.0 - 0.4 * specks(rng, 0.008, (1.0, 6.0))), 1.2, 0.5)


def fabric(rng: np.random.Generator) -> Material:
    """Coarse weave of partitions and seats."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    thread = np.sin(2 * np.pi * x / 8.0) * np.sin(2 * np.pi * y / 8.0)
    value = 0.3 * (1.0 + 0.18 * thread + 0.22 * fractal(rng, 0.6, 20, 300) + 0.1 * fractal(rng, 1.0, 2, 30))
    return _material(value, 1.0, 0.5)


def cork(rng: np.random.Generator) -> Material:
    crumbs = 0.22 * specks(rng, 0.3, (2.0, 7.0)) - 0.26 * specks(rng, 0.12, (1.5, 5.0))
    return _material((0.4 + crumbs) * (1.0 + 0.08 * fractal(rng, 1.0, 3, 300)), 1.4, 0.3)


def cardboard(rng: np.random.Generator) -> Material:
    flutes = fractal(rng, 0.3, 100, 500, stretch=0.05)
    return _material(0.44 * (1.0 + 0.05 * flutes + 0.1 * fractal(rng, 1.0, 2, 200)), 1.2, 0.5)


def rock(rng: np.random.Generator) -> Material:
    height = fractal(rng, 1.3, 3, 400)
    return _material(0.34 * (1.0 + 0.2 * fractal(rng, 1.0, 3, 400)) + relief(height, 0.5), 3.0, 0.6)


def lamp_face(rng: np.random.Generator) -> Material:
    """The pale cover of a lamp, seen where it does not shine."""
    return _material(np.full((SIZE, SIZE), 0.8), 1.0, 0.0)


MATERIALS: dict[str, Callable[[np.random.Generator], Material]] = {
    f.__name__: f
    for f in (
        stain, brick, block, roughcast, paint, concrete, asphalt, terrazzo, tiles, carpet, ceiling, planks, oak,
        laminate, metal, fabric, cork, cardboard, rock, lamp_face,
    )
}  # fmt: skip
MATERIALS["white_brick"] = lambda rng: brick(rng, body=0.68, joint=0.5)
MATERIALS["dark_planks"] = lambda rng: planks(rng, shade=0.26)


def make(name: str, seed: int) -> Material:
    """A material by its name; the same name and seed give the same picture whatever else was made before."""
    return MATERIALS[name](np.random.default_rng([seed, zlib.crc32(name.encode())]))
