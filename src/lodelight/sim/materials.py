"""Procedural surfaces: reflectance pictures that tile without a seam, with structure at every scale.

Real walls carry grain of a millimetre, blotches of a hand and shades of a metre at once; a surface that lacks one of
them looks painted and starves corner detectors at some distance. Each material here is a pattern (bricks, planks,
tiles) on top of fractal noise that spans the whole range.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from lodelight.types import Array, ArrayF32, Bytes

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
    mean_area = np.pi * squash * (radius_px[0] ** 2 + radius_px[0] * radius_px[1] + radius_px[1] ** 2) / 3.0
    radius = rng.uniform(*radius_px, int(share * SIZE * SIZE / mean_area))
    return _ellipses(rng, np.zeros((SIZE, SIZE), np.uint8), radius, squash, (120, 255))


def leaves(rng: np.random.Generator, smallest_px: float, largest_px: float, squash: float = 0.7) -> Array:
    """(SIZE, SIZE) shapes of every size over one another, values in [0, 1]: contrast with sharp edges at every scale.

    Radii follow r^-3, which makes the picture look the same at every distance (dead leaves; Lee, Mumford 2001).
    """
    count = int(0.6 * (SIZE / smallest_px) ** 2 / (np.pi * squash))
    u = rng.random(count)
    radius = (u / largest_px**2 + (1.0 - u) / smallest_px**2) ** -0.5
    return _ellipses(rng, np.full((SIZE, SIZE), 128, np.uint8), np.sort(radius)[::-1], squash, (0, 255))


def _ellipses(rng: np.random.Generator, canvas: Bytes, radius: Array, squash: float, tones: tuple[int, int]) -> Array:
    """Ellipses of given radii anywhere on a canvas that joins at its edges, in [0, 1]."""
    center, angle = rng.uniform(0, SIZE, (len(radius), 2)), rng.uniform(0, 180, len(radius))
    tone = rng.integers(*tones, len(radius), endpoint=True)
    for (x, y), r, a, grey in zip(center.tolist(), radius.tolist(), angle.tolist(), tone.tolist(), strict=True):
        axes = int(16 * r), int(16 * max(r * squash, 0.5))  # in sixteenths of a pixel, as `shift` says
        for cx in (x, x - SIZE if x + r >= SIZE else x + SIZE if x < r else None):
            for cy in (y, y - SIZE if y + r >= SIZE else y + SIZE if y < r else None):
                if cx is not None and cy is not None:
                    at = int(16 * cx), int(16 * cy)
                    cv2.ellipse(canvas, at, axes, a, 0, 360, grey, -1, cv2.LINE_AA, shift=4)
    return canvas / 255.0


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
    """Coarse plaster, patched and weathered: grain of some millimetres lit from the side, chips, blotches."""
    height = fractal(rng, 0.5, 60, 330)
    patches = leaves(rng, 3.0, 60.0)
    value = 0.6 * (0.72 + 0.5 * patches) + relief(height, 0.06) + 0.04 * fractal(rng, 1.0, 3, 200)
    return _material(value * (1.0 - 0.6 * specks(rng, 0.03, (1.0, 5.0))), 2.0, 0.45)


def pebbles(rng: np.random.Generator) -> Material:
    """Washed concrete: stones of every size."""
    stones = leaves(rng, 2.5, 40.0)
    return _material(0.16 + 0.62 * stones + 0.02 * fractal(rng, 0.5, 60, 400), 1.9, 0.4)


def mosaic(rng: np.random.Generator) -> Material:
    """Small tiles of many greys."""
    cells, inside = bond(rng, 32, 32, 0.0, 3.0, 0.4)
    face = (0.2 + 0.6 * cells) * (1.0 + 0.1 * fractal(rng, 0.8, 10, 500))
    return _material(0.5 + (face - 0.5) * inside + relief(inside, 0.05), 1.7, 0.3)


def slats(rng: np.random.Generator) -> Material:
    """Upright wooden slats with shadow between them."""
    board = planks(rng, shade=0.45).picture.T.astype(np.float64)
    return _material(board * (1.0 - 0.5 * specks(rng, 0.02, (2.0, 8.0), 0.5)), 1.6, 0.35)


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
    """Glazed wall tiles, each with a printed ornament of its own tone."""
    cells, inside = bond(rng, 10, 10, 0.0, 4.0, 0.0)
    y, x = np.mgrid[0:SIZE, 0:SIZE] % (SIZE / 10) / (SIZE / 10) - 0.5
    ornament = np.cos(4 * np.pi * np.hypot(x, y)) * np.cos(4 * np.arctan2(y, x)) > 0.25
    face = (
        0.68 * (0.75 + 0.4 * cells) * (1.0 - 0.45 * ornament * (cells * 7 % 1)) * (1.0 + 0.08 * fractal(rng, 1, 4, 400))
    )
    return _material(0.3 + (face - 0.3) * inside + relief(inside, 0.08), 1.5, 0.35)


def carpet(rng: np.random.Generator) -> Material:
    cells, inside = bond(rng, 4, 4, 0.0, 2.0, 0.0)
    flecks = 0.36 * specks(rng, 0.16, (1.5, 9.0), 0.4) - 0.16 * specks(rng, 0.2, (1.5, 9.0), 0.4)
    face = (0.28 + flecks) * (0.85 + 0.3 * cells) * (1.0 + 0.22 * fractal(rng, 0.3, 100, 500))
    return _material(face * (0.8 + 0.2 * inside), 2.0, 0.5)


def ceiling(rng: np.random.Generator) -> Material:
    """Mineral fibre tiles of 0.6 m with pinholes and fissures in their frame."""
    _, inside = bond(rng, 3, 3, 0.0, 12.0, 0.0)
    holes = np.maximum(specks(rng, 0.03, (0.9, 2.4), 1.0), specks(rng, 0.10, (4.0, 14.0), 0.3))
    face = 0.76 * (1.0 + 0.04 * fractal(rng, 0.8, 5, 300)) * (1.0 - 0.7 * holes)
    return _material(0.85 + (face - 0.85) * inside + relief(inside, 0.1), 1.8, 0.3)


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


def vinyl(rng: np.random.Generator) -> Material:
    """A plain floor covering."""
    return _material(0.45 * (1.0 + 0.015 * fractal(rng, 0.8, 10, 400)), 2.0, 0.08)


def corrugated(rng: np.random.Generator) -> Material:
    """Ribbed sheet with rust and rivets, ribs upright."""
    rib = np.cos(2 * np.pi * np.arange(SIZE) / (SIZE / 16))[None, :]
    rust = np.clip(fractal(rng, 1.0, 2, 300) - 0.6, 0.0, 1.5)
    value = 0.5 * (1.0 + 0.28 * rib + 0.06 * fractal(rng, 0.7, 10, 500)) * (1.0 - 0.35 * rust)
    return _material(value * (1.0 - 0.6 * specks(rng, 0.02, (2.0, 6.0))), 2.4, 0.4)


def rock(rng: np.random.Generator) -> Material:
    """Hewn stone, lit from the side."""
    facets = leaves(rng, 4.0, 90.0, 0.55)
    height = fractal(rng, 1.3, 3, 400)
    return _material(0.2 + 0.28 * facets + relief(height, 0.35), 3.0, 0.6)


def lamp_face(rng: np.random.Generator) -> Material:
    """The pale cover of a lamp, seen where it does not shine."""
    return _material(np.full((SIZE, SIZE), 0.8), 1.0, 0.0)


MATERIALS: dict[str, Callable[[np.random.Generator], Material]] = {
    f.__name__: f
    for f in (
        stain, brick, block, roughcast, pebbles, mosaic, slats, paint, concrete, asphalt, terrazzo, tiles, carpet,
        ceiling, planks, oak, laminate, metal, fabric, cork, cardboard, vinyl, corrugated, rock, lamp_face,
    )
}  # fmt: skip
MATERIALS["white_brick"] = lambda rng: brick(rng, body=0.68, joint=0.5)
MATERIALS["dark_planks"] = lambda rng: planks(rng, shade=0.26)


@lru_cache(maxsize=32)  # a building's worth: the next recording of the same building has its pictures at once
def make(name: str, seed: int) -> Material:
    """A material by its name; the same name and seed give the same picture whatever else was made before."""
    material = MATERIALS[name](np.random.default_rng([seed, zlib.crc32(name.encode())]))
    material.picture.setflags(write=False)
    return material
