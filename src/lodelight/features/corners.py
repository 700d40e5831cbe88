"""Where corners are: FAST, spread over an image cell by cell. Source: Rosten and Drummond 2006.

A pixel is a corner if nine in a row of the circle of 16 around it are all brighter, or all darker, by more than a
threshold. Its strength, the most by which nine in a row all differ, is found for every pixel without a branch and in
bytes, which the compiler does for 32 pixels at a time.
"""

from __future__ import annotations

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.types import Bytes, Ints

RADIUS = 3
Circle = tuple[np.uint8, ...]


def find_corners(image: Bytes, quota: int, threshold: int, border: int) -> Ints:
    """(N, 2) int pixels: the strongest corner of every cell, then the second of every cell, up to the quota.

    `quota` : also about the number of cells
    `threshold` : grey values
    `border` : so far from the image's edges corners lie, and the pixels of their circles
    """
    height, width = image.shape[0] - 2 * border, image.shape[1] - 2 * border
    return _spread(strengths(image, border + RADIUS), quota, threshold, border, math.sqrt(height * width / quota))


@kernel
def _spread(strength: Bytes, quota: int, threshold: int, border: int, cell_px: float) -> Ints:
    height, width = strength.shape[0] - 2 * border, strength.shape[1] - 2 * border
    columns = int(width / cell_px) + 1
    px, n = np.empty(((height + 1) // 2 * ((width + 1) // 2), 2), np.int32), 0  # no two peaks touch
    stronger = np.zeros(257, np.int64)  # at 255 - s: how many are stronger than s
    for y in range(height):
        row = strength[y + border, border : border + width]
        for x in range(width):
            if row[x] > threshold and _is_peak(strength, x + border, y + border):
                px[n, 0], px[n, 1] = x, y
                stronger[256 - row[x]] += 1
                n += 1
    rank = np.cumsum(stronger)
    order = np.empty(n, np.int32)
    for i in range(n):
        s = 255 - strength[px[i, 1] + border, px[i, 0] + border]
        order[rank[s]] = i
        rank[s] += 1
    taken = np.zeros(columns * (int(height / cell_px) + 1), np.int32)
    before = np.empty(n, np.int32)  # how many corners of its own cell are stronger
    for k in range(n):
        i = order[k]
        cell = int(px[i, 1] / cell_px) * columns + int(px[i, 0] / cell_px)
        before[i] = taken[cell]
        taken[cell] += 1
    out, found, turn = np.empty((min(n, quota), 2), np.int32), 0, 0
    while found < len(out):
        for k in range(n):
            i = order[k]
            if before[i] == turn and found < len(out):
                out[found, 0], out[found, 1] = px[i, 0] + border, px[i, 1] + border
                found += 1
        turn += 1
    return out


@kernel
def _is_peak(strength: Bytes, x: int, y: int) -> bool:
    """Whether no pixel beside (x, y) is as strong."""
    here = strength[y, x]
    above, beside, below = strength[y - 1, x - 1 : x + 2], strength[y, x - 1 : x + 2], strength[y + 1, x - 1 : x + 2]
    around = max(above[0], above[1], above[2], beside[0], beside[2], below[0], below[1], below[2])
    return bool(around < here)


@kernel
def strengths(image: Bytes, edge: int) -> Bytes:
    """The strength of every pixel as a corner, 0 nearer than `edge` to an edge of the image.

    A pixel is a corner at a threshold below its strength; `cv2.FastFeatureDetector` calls strength - 1 its response.
    """
    out = np.zeros_like(image)
    for y in range(edge, image.shape[0] - edge):
        middle, to = image[y, edge:-edge], out[y, edge:-edge]
        u3, u2, u1 = image[y - 3, edge - 1 :], image[y - 2, edge - 2 :], image[y - 1, edge - 3 :]
        d3, d2, d1 = image[y + 3, edge - 1 :], image[y + 2, edge - 2 :], image[y + 1, edge - 3 :]
        beside = image[y, edge - 3 :]
        for x in range(to.size):
            circle = (
                d3[x + 1], d3[x + 2], d2[x + 4], d1[x + 6], beside[x + 6], u1[x + 6], u2[x + 4], u3[x + 2],
                u3[x + 1], u3[x], u2[x], u1[x], beside[x], d1[x], d2[x], d3[x],
            )  # fmt: skip
            here, turned = middle[x], np.uint8(~middle[x])
            brighter = np.uint8(max(_least_of_nine(circle), here) - here)
            darker = np.uint8(max(_least_of_nine(_turned(circle)), turned) - turned)
            to[x] = max(brighter, darker)
    return out


@kernel
def _turned(p: Circle) -> Circle:
    """Dark for bright."""
    b = np.uint8
    return (
        b(~p[0]), b(~p[1]), b(~p[2]), b(~p[3]), b(~p[4]), b(~p[5]), b(~p[6]), b(~p[7]),
        b(~p[8]), b(~p[9]), b(~p[10]), b(~p[11]), b(~p[12]), b(~p[13]), b(~p[14]), b(~p[15]),
    )  # fmt: skip


@kernel
def _least_of_nine(p: Circle) -> np.uint8:
    """The least of nine in a row, of those nine of which it is greatest.

    Nine are eight from an odd one on, with the one before or the one behind; eight are two times two times two. Written
    out, as a loop is 300 times slower.
    """
    a1, a3, a5, a7 = min(p[1], p[2]), min(p[3], p[4]), min(p[5], p[6]), min(p[7], p[8])
    a9, a11, a13, a15 = min(p[9], p[10]), min(p[11], p[12]), min(p[13], p[14]), min(p[15], p[0])
    b1, b3, b5, b7 = min(a1, a3), min(a3, a5), min(a5, a7), min(a7, a9)
    b9, b11, b13, b15 = min(a9, a11), min(a11, a13), min(a13, a15), min(a15, a1)
    return max(
        max(min(b1, b5, max(p[0], p[9])), min(b3, b7, max(p[2], p[11]))),
        max(min(b5, b9, max(p[4], p[13])), min(b7, b11, max(p[6], p[15]))),
        max(min(b9, b13, max(p[8], p[1])), min(b11, b15, max(p[10], p[3]))),
        max(min(b13, b1, max(p[12], p[5])), min(b15, b3, max(p[14], p[7]))),
    )
