"""Depth held against the image: where a surface breaks off, the image shows a rim at the same place.

Depth that lies beside the image has all rims beside those of the image. A turn of the depth sensor moves them by one
angle, a shift the near ones more than the far ones, so bands of distance are looked at by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, pairwise

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lodelight.types import ArrayF32, Bytes

BREAK, BREAK_M = 0.12, 0.2  # by how much farther the surface behind a rim is, as a share and at least
BANDS_M = (0.0, 1.5, 2.5, 4.0, 8.0)
PER_BAND, AT_LEAST = 400, 30  # rims looked at, of a band of one image
REACH_RAD = 0.07  # so far they are looked for
CLEAR = 5.0  # deviations by which the best place must stand out of all others
RIVAL = 1.15  # and by so much more than the next best: shelves and bricks look alike a step aside
BLOCKS = 6  # of a recording, each left out once
PIXEL = 0.7  # to which a place is told, both axes together


@dataclass(frozen=True, eq=False)
class Rims:
    """Of one image and band: how strong the image's gradient is, in the mean, at rims moved by (dx, dy).

    strength : (2 R + 1, 2 R + 1), by dy + R and dx + R
    """

    band: int
    distance_m: float
    count: int
    strength: ArrayF32


@dataclass(frozen=True)
class Beside:
    """px : by how much depth lies beside the image, (x, y) at `distance_m`; sigma_px : of its length."""

    px: tuple[float, float]
    sigma_px: float
    distance_m: float
    bands: tuple[tuple[float, float, float], ...]  # (distance m, x px, y px) of each


def rims_of(image: Bytes, depth: ArrayF32, focal_px: float) -> list[Rims]:
    """`depth` (H, W) m in the image's pixels, 0 or not finite where there is none."""
    reach = max(4, round(REACH_RAD * focal_px))
    z = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)
    is_rim = _near_sides(z)
    edges = np.pad(_edges(image, 2 * reach + 1), reach)
    around = sliding_window_view(edges, (2 * reach + 1, 2 * reach + 1))
    out = []
    for band, (low, high) in enumerate(pairwise(BANDS_M)):
        v, u = np.nonzero(is_rim & (z >= low) & (z < high))
        if len(v) < AT_LEAST:
            continue
        some = np.linspace(0, len(v) - 1, min(len(v), PER_BAND)).astype(int)
        v, u = v[some], u[some]
        strength = around[v, u].mean(axis=0).astype(np.float32)
        out.append(Rims(band, 1.0 / float(np.mean(1.0 / z[v, u])), len(v), strength))
    return out


def beside(frames: list[list[Rims]]) -> Beside | None:
    """What all images together show, None where rims stand out in fewer than two bands of distance."""
    block = np.arange(len(frames)) * BLOCKS // max(len(frames), 1)
    bands, px, distance_m, variance = [], [], [], []
    for band in range(len(BANDS_M) - 1):
        mine = [[rims for rims in frame if rims.band == band] for frame in frames]
        found = _found(mine)
        without = [_found([m for m, b in zip(mine, block, strict=True) if b != left]) for left in range(BLOCKS)]
        if found is None or None in without:
            continue
        moved = np.array([np.subtract(w[:2], found[:2]) for w in without if w is not None])
        px.append(found[:2])
        distance_m.append(found[2])
        variance.append(PIXEL**2 + (BLOCKS - 1) / BLOCKS * float(np.sum(moved**2)))
        bands.append((found[2], *found[:2]))
    if len(bands) < 2:  # one alone has nothing that would contradict it
        return None
    weight = 1.0 / np.array(variance)
    x, y = np.average(np.array(px), axis=0, weights=weight).tolist()
    middle_m = 1.0 / float(np.average(1.0 / np.array(distance_m), weights=weight))
    return Beside((x, y), float(weight.sum() ** -0.5), middle_m, tuple(bands))


def _near_sides(z: ArrayF32) -> NDArray[np.bool_]:
    """(H, W) bool: pixels beside which the next surface is much farther."""
    rim = np.zeros(z.shape, bool)
    for axis in (0, 1):
        for step in (1, -1):
            next_z = np.roll(z, step, axis)
            rim |= (z > 0) & (next_z > (1.0 + BREAK) * z) & (next_z - z > BREAK_M)
    rim[[0, -1]] = rim[:, [0, -1]] = False
    return rim


def _edges(image: Bytes, window_px: int) -> ArrayF32:
    """The gradient's strength, less its mean around: 1 for the strongest twentieth."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    strength = np.minimum(strength / max(float(np.percentile(strength, 95)), 1e-6), 1.0)
    return np.asarray(strength - cv2.blur(strength, (window_px, window_px)), np.float32)


def _found(frames: list[list[Rims]]) -> tuple[float, float, float] | None:
    """Where depth lies, (x, y) px from the image, by the rims of a band, and their distance in m."""
    rims = list(chain.from_iterable(frames))
    if not rims:
        return None
    count = np.array([r.count for r in rims], float)
    total = np.average([r.strength for r in rims], axis=0, weights=count).astype(np.float32)
    total = np.asarray(cv2.GaussianBlur(total, (0, 0), 1.0), np.float32)
    middle = float(np.median(total))
    deviation = 1.48 * float(np.median(np.abs(total - middle)))
    y, x = np.unravel_index(int(np.argmax(total)), total.shape)
    reach = total.shape[0] // 2
    elsewhere = total.copy()
    near = max(2, reach // 5)
    elsewhere[max(y - near, 0) : y + near + 1, max(x - near, 0) : x + near + 1] = middle
    if total[y, x] - middle < max(CLEAR * deviation, RIVAL * float(elsewhere.max() - middle)):
        return None
    return float(reach - x), float(reach - y), float(count.sum() / np.sum(count / [r.distance_m for r in rims]))
