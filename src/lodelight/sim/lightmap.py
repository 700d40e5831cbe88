"""Light and shadow, computed once per building: irradiance on a grid over every quad.

Direct light of the lamps with soft shadows, then diffuse bounces gathered over the hemisphere
(radiosity by ray casting; Cohen and Wallace 1993, chapter 8).
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lodelight.compiled import kernel
from lodelight.sim.bvh import STACK, cast_ray
from lodelight.sim.scene import ALBEDO, LAMP, LIGHT_FIRST, LIGHT_H, LIGHT_W, Scene
from lodelight.types import Array, ArrayF32, Ints

GATHER = (48, 24, 12)  # rays per texel, bounce after bounce: each is fainter and smoother than the one before
SAMPLES = 2  # per side of a lamp
OFF_SURFACE_M = 1e-3
NEGLIGIBLE = 0.004  # of the light straight under a lamp: one lamp's part below it is not traced


def bake(scene: Scene, threads: int = 2) -> None:
    """Fill `scene.light`. The same bytes for any number of threads: every texel is computed on its own."""
    lamps = np.array(
        [[*lamp.center, *lamp.normal, *lamp.size_m, lamp.radiance] for lamp in scene.lamps if lamp.on]
    ).reshape(-1, 9)
    areas = lamps[:, 6] * lamps[:, 7] * np.where([lamp.disc for lamp in scene.lamps if lamp.on], math.pi / 4, 1.0)
    lamps = np.ascontiguousarray(np.hstack([lamps, areas[:, None]]))
    tree = scene.tree
    direct, smooth, before = (np.zeros_like(scene.light) for _ in range(3))
    n = len(scene.geometry)
    cuts = np.linspace(0, n, 8 * threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:

        def everywhere(function, *args) -> None:  # type: ignore[no-untyped-def]
            list(pool.map(lambda k: function(int(cuts[k]), int(cuts[k + 1]), *args), range(len(cuts) - 1)))

        where = (tree.boxes, tree.links, tree.order, scene.geometry, scene.paint)
        everywhere(_direct, *where, lamps, direct)
        scene.light[:] = direct
        for rays in GATHER:
            directions = _hemisphere(rays)
            before[:] = scene.light
            everywhere(_gather, *where, scene.scale, directions, before, smooth)
            everywhere(_smooth, scene.paint, direct, smooth, scene.light)


def _hemisphere(n: int) -> Array:
    """(n, 3) directions about z, spread so that their mean is the cosine-weighted one (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    radius, angle = np.sqrt(k / n), k * math.pi * (3.0 - math.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1)


@kernel
def _texel(g: Array, paint: Ints, k: int, out: Array) -> None:
    """World point of texel k of a quad, a little in front of it."""
    w = paint[LIGHT_W]
    a, b = (k % w + 0.5) / w, (k // w + 0.5) / paint[LIGHT_H]
    for i in range(3):
        out[i] = g[i] + a * g[12 + i] + b * g[15 + i] + OFF_SURFACE_M * g[3 + i]


@kernel
def _direct(
    first: int,
    last: int,
    boxes: Array,
    links: Ints,
    order: Ints,
    geometry: Array,
    paint: Ints,
    lamps: Array,
    out: ArrayF32,
) -> None:
    x, d, stack = np.empty(3), np.empty(3), np.empty(STACK, np.int32)
    for q in range(first, last):
        g = geometry[q]
        for k in range(paint[q, LIGHT_W] * paint[q, LIGHT_H]):
            _texel(g, paint[q], k, x)
            total = 0.0
            for j in range(lamps.shape[0]):
                lamp = lamps[j]
                # The lamp's own axes: a square of SAMPLES by SAMPLES points in its plane
                ux, uy = (1.0, 0.0) if abs(lamp[3]) < 0.9 else (0.0, 1.0)
                nx, ny, nz = lamp[3], lamp[4], lamp[5]
                dot = ux * nx + uy * ny
                ax, ay, az = ux - dot * nx, uy - dot * ny, -dot * nz
                norm = math.sqrt(ax * ax + ay * ay + az * az)
                ax, ay, az = ax / norm, ay / norm, az / norm
                bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
                rx, ry, rz = lamp[0] - x[0], lamp[1] - x[1], lamp[2] - x[2]
                r2 = rx * rx + ry * ry + rz * rz
                bound = lamp[8] * lamp[9] / max(r2, 0.25)
                samples = SAMPLES if bound > 0.05 * lamp[8] * lamp[9] else 1
                if bound < NEGLIGIBLE * lamp[8] * lamp[9]:
                    continue
                for s in range(samples * samples):
                    e = ((s % samples + 0.5) / samples - 0.5) * lamp[6]
                    f = ((s // samples + 0.5) / samples - 0.5) * lamp[7]
                    d[0] = rx + e * ax + f * bx
                    d[1] = ry + e * ay + f * by
                    d[2] = rz + e * az + f * bz
                    dist = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
                    for i in range(3):
                        d[i] /= dist
                    cos_x = g[3] * d[0] + g[4] * d[1] + g[5] * d[2]
                    cos_l = -(nx * d[0] + ny * d[1] + nz * d[2])
                    part = lamp[8] * lamp[9] * cos_x * cos_l / (max(dist, 0.1) ** 2 * samples * samples)
                    if cos_x <= 0.0 or cos_l <= 0.0:
                        continue
                    t, _ = cast_ray(boxes, links, order, geometry, stack, x, d, dist - 0.02, True)
                    if t == np.inf:
                        total += part
            out[paint[q, LIGHT_FIRST] + k] = total


@kernel
def _gather(
    first: int,
    last: int,
    boxes: Array,
    links: Ints,
    order: Ints,
    geometry: Array,
    paint: Ints,
    scale: ArrayF32,
    directions: Array,
    before: ArrayF32,
    out: ArrayF32,
) -> None:
    x, d, stack = np.empty(3), np.empty(3), np.empty(STACK, np.int32)
    n = directions.shape[0]
    for q in range(first, last):
        g = geometry[q]
        ul, vl = math.sqrt(g[12] ** 2 + g[13] ** 2 + g[14] ** 2), math.sqrt(g[15] ** 2 + g[16] ** 2 + g[17] ** 2)
        for k in range(paint[q, LIGHT_W] * paint[q, LIGHT_H]):
            _texel(g, paint[q], k, x)
            total = 0.0
            turn = 2.399963 * ((k * 7919 + q * 104729) % 64)  # another turn of the lattice at every texel
            ct, st = math.cos(turn), math.sin(turn)
            for j in range(n):
                e = ct * directions[j, 0] - st * directions[j, 1]
                f = st * directions[j, 0] + ct * directions[j, 1]
                for i in range(3):
                    d[i] = e * g[12 + i] / ul + f * g[15 + i] / vl + directions[j, 2] * g[3 + i]
                t, hit = cast_ray(boxes, links, order, geometry, stack, x, d, 1e9, False)
                if hit < 0 or paint[hit, LAMP] >= 0:
                    continue
                h = geometry[hit]
                if h[3] * d[0] + h[4] * d[1] + h[5] * d[2] > 0.0:
                    continue  # its unlit back
                px, py, pz = x[0] + t * d[0] - h[0], x[1] + t * d[1] - h[1], x[2] + t * d[2] - h[2]
                w, rows = paint[hit, LIGHT_W], paint[hit, LIGHT_H]
                c = min(w - 1, int(max(0.0, h[6] * px + h[7] * py + h[8] * pz) * w))
                r = min(rows - 1, int(max(0.0, h[9] * px + h[10] * py + h[11] * pz) * rows))
                total += scale[hit, ALBEDO] * before[paint[hit, LIGHT_FIRST] + r * w + c]
            out[paint[q, LIGHT_FIRST] + k] = total / n


@kernel
def _smooth(first: int, last: int, paint: Ints, direct: ArrayF32, gathered: ArrayF32, out: ArrayF32) -> None:
    """out = direct + the gathered light averaged over 3 by 3 texels, which removes the grain of few rays."""
    for q in range(first, last):
        w, h, start = paint[q, LIGHT_W], paint[q, LIGHT_H], paint[q, LIGHT_FIRST]
        for r in range(h):
            for c in range(w):
                total, count = 0.0, 0
                for rr in range(max(0, r - 1), min(h, r + 2)):
                    for cc in range(max(0, c - 1), min(w, c + 2)):
                        total += gathered[start + rr * w + cc]
                        count += 1
                k = start + r * w + c
                out[k] = direct[k] + total / count
