"""What rays see where they meet a quad: filtered texture, stain, light map, lamps.

One kernel without calls that take arrays: such a call inside a loop counts references with locked instructions, which
here cost more than the arithmetic.
"""

import math

import numpy as np
from numpy.typing import NDArray

from lodelight.compiled import kernel
from lodelight.sim.scene import (
    FILLS,
    HEIGHT_M,
    LAMP,
    LIGHT_FIRST,
    LIGHT_H,
    LIGHT_W,
    PERIODS_U,
    PERIODS_V,
    SHADE,
    SHIFT_U,
    SHIFT_V,
    STAIN,
    TEXTURE,
    WIDTH_M,
)
from lodelight.types import Array, ArrayF32, Bytes, Ints

MAX_TAPS = 8
STAIN_PERIOD_M = 7.3  # no whole multiple of any material's period: the pair repeats nowhere in a building
MANTISSA = 1.0 / (1 << 23)


@kernel
def log2_of(x: float) -> float:
    """log2 to 0.09, enough to choose a level: the bits of a float are its logarithm, nearly (Blinn 1997)."""
    out: float = np.float32(x).view(np.int32) * MANTISSA - 127.0
    return out


@kernel
def lamp_profile(disc: bool, a: float, b: float) -> float:
    """A lamp's brightness at (a, b) of its face: even on a panel; on a disc bell-shaped, with wings."""
    if not disc:
        return 1.0
    r2 = 16.0 * ((a - 0.5) * (a - 0.5) + (b - 0.5) * (b - 0.5))  # 1 at the nominal radius, half of the face's
    return 1.0 / (1.0 + r2**4) if r2 < 4.0 else 0.0


@kernel
def shade_rays(
    n: int, quad: Ints, row: Ints, o: ArrayF32, d: ArrayF32, right: ArrayF32, down: ArrayF32, apex: Array,
    g: Array, paint: Ints, scale: ArrayF32, texels: Bytes, table: NDArray[np.int64], light: ArrayF32,
    lamps: Array, brightness: Array, value: Array, distance: Array,
) -> None:  # fmt: skip
    """Radiance and distance along n rays that meet the quads `quad`.

    o, d : (3, n) origin relative to `apex` and direction; right, down : (3, n) rays one pixel on, minus d
    row : (n,) image row, for the lamps' brightness.

    The mean of a texture over a pixel's footprint is taken by trilinear taps along the footprint's longer edge
    (Heckbert 1989 for footprints; the taps as graphics hardware sets them).
    """
    for i in range(n):
        q = quad[i]
        # Where on the quad, as a, b in [0, 1]
        nx, ny, nz, ux, uy, uz = g[q, 3], g[q, 4], g[q, 5], g[q, 6], g[q, 7], g[q, 8]
        vx, vy, vz = g[q, 9], g[q, 10], g[q, 11]
        dx, dy, dz = float(d[0, i]), float(d[1, i]), float(d[2, i])
        px, py, pz = apex[0] - g[q, 0] + o[0, i], apex[1] - g[q, 1] + o[1, i], apex[2] - g[q, 2] + o[2, i]
        inverse = 1.0 / (nx * dx + ny * dy + nz * dz)
        t = -(nx * px + ny * py + nz * pz) * inverse
        hx, hy, hz = px + t * dx, py + t * dy, pz + t * dz
        a, b = ux * hx + uy * hy + uz * hz, vx * hx + vy * hy + vz * hz
        distance[i] = t
        # The plane turns a step of the ray into a step on it: dp = t (dd - d (n . dd) / (n . d))
        ex, ey, ez = float(right[0, i]), float(right[1, i]), float(right[2, i])
        k = (nx * ex + ny * ey + nz * ez) * inverse
        ex, ey, ez = t * (ex - k * dx), t * (ey - k * dy), t * (ez - k * dz)
        ax, bx = ux * ex + uy * ey + uz * ez, vx * ex + vy * ey + vz * ez
        ex, ey, ez = float(down[0, i]), float(down[1, i]), float(down[2, i])
        k = (nx * ex + ny * ey + nz * ez) * inverse
        ex, ey, ez = t * (ex - k * dx), t * (ey - k * dy), t * (ez - k * dz)
        ay, by = ux * ex + uy * ey + uz * ez, vx * ex + vy * ey + vz * ez

        reflectance = float(scale[q, SHADE])
        stain = float(scale[q, STAIN])
        shift_u, shift_v = float(scale[q, SHIFT_U]), float(scale[q, SHIFT_V])
        for layer in range(2 if stain > 0.0 else 1):
            if layer == 0:
                picture, wrap = paint[q, TEXTURE], paint[q, FILLS] == 0
                pu, pv = float(scale[q, PERIODS_U]), float(scale[q, PERIODS_V])
                s, v = a * pu + shift_u, b * pv + shift_v
            else:
                picture, wrap = 0, True
                pu, pv = float(scale[q, WIDTH_M]) / STAIN_PERIOD_M, float(scale[q, HEIGHT_M]) / STAIN_PERIOD_M
                s, v = a * pu + 3.7 * shift_u, b * pv + 5.3 * shift_v
            log_w, log_h, levels = table[picture, 1], table[picture, 2], table[picture, 3]
            w, h = float(1 << log_w), float(1 << log_h)
            # Longer and shorter edge of the footprint, texels squared
            su, sv = ax * pu, bx * pv
            long2 = su * su * w * w + sv * sv * h * h
            short2 = (ay * pu * w) ** 2 + (by * pv * h) ** 2
            if long2 < short2:
                long2, short2, su, sv = short2, long2, ay * pu, by * pv
            taps = 1
            if long2 > 1.7 * short2 and long2 > 1.0 and layer == 0:
                taps = min(MAX_TAPS, math.ceil(math.sqrt(long2 / max(short2, 1.0))))
            width2 = max(long2 / (taps * taps), short2)
            lod = min(0.5 * log2_of(width2), levels - 1.0) if width2 > 1.0 else 0.0
            level = int(lod) if layer == 0 else int(lod + 0.5)
            part = lod - level if layer == 0 else 0.0  # stains are smooth: one level does
            total = 0.0
            for j in range(2 if part > 0.0 else 1):
                # Levels lie one behind the other, each a quarter of the one before
                full = 1 << (log_w + log_h)
                start = table[picture, 0] + (4 * (full - (full >> (2 * (level + j))))) // 3
                lw = log_w - level - j
                iw, ih = 1 << lw, 1 << (log_h - level - j)
                level_sum = 0.0
                for tap in range(taps):
                    along = (tap + 0.5) / taps - 0.5
                    x, y = (s + along * su) * iw - 0.5, (v + along * sv) * ih - 0.5
                    x0, y0 = math.floor(x), math.floor(y)
                    fx, fy = x - x0, y - y0
                    if wrap:
                        x1, y1 = (x0 + 1) & (iw - 1), (y0 + 1) & (ih - 1)
                        x0, y0 = x0 & (iw - 1), y0 & (ih - 1)
                    else:
                        x1, y1 = min(max(x0 + 1, 0), iw - 1), min(max(y0 + 1, 0), ih - 1)
                        x0, y0 = min(max(x0, 0), iw - 1), min(max(y0, 0), ih - 1)
                    r0, r1 = start + (y0 << lw), start + (y1 << lw)
                    e, f = float(texels[r0 + x0]), float(texels[r1 + x0])
                    e += fx * (float(texels[r0 + x1]) - e)
                    f += fx * (float(texels[r1 + x1]) - f)
                    level_sum += e + fy * (f - e)
                total += level_sum * (part if j == 1 else 1.0 - part)
            total /= 255.0 * taps
            reflectance *= total if layer == 0 else 1.0 + stain * (total - 0.5)

        # Irradiance, bilinear between the centres of the light map's texels
        lw, lh, start = paint[q, LIGHT_W], paint[q, LIGHT_H], paint[q, LIGHT_FIRST]
        x, y = min(max(a * lw - 0.5, 0.0), lw - 1.0), min(max(b * lh - 0.5, 0.0), lh - 1.0)
        x0, y0 = int(x), int(y)
        fx, fy = x - x0, y - y0
        r0 = start + y0 * lw + x0
        r1 = r0 + (lw if y0 + 1 < lh else 0)
        step = 1 if x0 + 1 < lw else 0
        e = light[r0] * (1.0 - fx) + light[r0 + step] * fx
        f = light[r1] * (1.0 - fx) + light[r1 + step] * fx
        value[i] = reflectance * (e * (1.0 - fy) + f * fy) / math.pi
        lamp = paint[q, LAMP]
        if lamp >= 0:
            shape = lamp_profile(lamps[lamp, 1] != 0.0, a, b)
            value[i] += lamps[lamp, 0] * brightness[row[i], lamp] * shape * reflectance  # a window shows its view
