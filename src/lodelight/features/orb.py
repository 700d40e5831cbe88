"""Oriented binary features: FAST corners spread over image and scales, sub-pixel, with 256-bit descriptors.

The descriptor compares 256 pairs of pixels of the smoothed patch, turned by the patch's orientation. The pairs were
chosen on real and rendered images by `tools/train_descriptor.py` and lie in `data/descriptor_pairs.npy`.
Sources: Rublee et al. 2011 (oriented BRIEF, intensity centroid, greedy choice of pairs); Foerstner and Guelch 1987
(sub-pixel corner).
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import cv2
import numpy as np

from lodelight.compiled import kernel
from lodelight.features.corners import find_corners
from lodelight.features.features import Features
from lodelight.geometry.cameras import Camera
from lodelight.types import Array, ArrayF32, Bytes, Ints, Words

PATCH_RADIUS = 15
BORDER = PATCH_RADIUS + 2
N_ANGLES = 64


@dataclass(frozen=True)
class OrbConfig:
    """n_features is per image; fast_threshold is the least contrast of a corner in grey values."""

    n_features: int = 1000
    n_levels: int = 8
    scale_factor: float = 1.2
    fast_threshold: int = 7

    def scale(self, octave: Ints) -> Array:
        """Size of a pixel of a pyramid level in pixels of the image: also its corners' noise relative to level 0."""
        out: Array = self.scale_factor ** octave.astype(np.float64)
        return out


class OrbExtractor:
    """Features of images of one camera."""

    def __init__(self, camera: Camera, config: OrbConfig | None = None) -> None:
        self.camera = camera
        self.config = config or OrbConfig()
        share = self.config.scale_factor ** -np.arange(self.config.n_levels)
        self._quota = np.maximum(1, np.rint(self.config.n_features * share / share.sum())).astype(int)

    def pyramid(self, image: Bytes) -> list[Bytes]:
        """The image and its reductions by the scale factor; levels too small for a patch are left out."""
        levels = [image]
        height, width = image.shape
        for level in range(1, self.config.n_levels):
            scale = self.config.scale_factor**level
            size = (round(width / scale), round(height / scale))
            if min(size) < 4 * BORDER:
                break
            levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_LINEAR), np.uint8))
        return levels

    def extract(self, pyramid: list[Bytes]) -> Features:
        """Corners of all levels of `pyramid(image)`, described; without depth."""
        found = list(_two_at_once().map(self._of_level, pyramid, self._quota))
        height, width = pyramid[0].shape
        for (px, _, _), level in zip(found, pyramid, strict=True):
            # a resized image keeps its edges, not its centres
            px[:] = (px + 0.5) * np.array([width / level.shape[1], height / level.shape[0]]) - 0.5
        octave_of = np.repeat(np.arange(len(found), dtype=np.int32), [len(px) for px, _, _ in found])
        px, angle, desc = (np.concatenate(column) for column in zip(*found, strict=True))
        ray, seen = self.camera.unproject(px)
        no_depth = np.zeros(len(px), np.float32)
        features = Features(px.astype(np.float32), octave_of, angle, desc, ray, no_depth, no_depth)
        return features if seen.all() else features.take(seen)

    def _of_level(self, level: Bytes, quota: int) -> tuple[Array, ArrayF32, Words]:
        """The corners of one level: px (N, 2) of that level, directions (N,) and descriptors (N, 4)."""
        corners = find_corners(level, quota, self.config.fast_threshold, BORDER)
        smooth = np.asarray(cv2.GaussianBlur(level, (7, 7), 2.0, borderType=cv2.BORDER_REFLECT_101), np.uint8)
        angle = orientations(level, corners)
        desc = describe(smooth, corners, angle, _pair_offsets(level.shape[1]))
        return refine_corners(level, corners), angle, desc


@cache
def _two_at_once() -> ThreadPoolExecutor:
    """For the levels of a pyramid: none needs another, and all that is slow about them releases the GIL."""
    return ThreadPoolExecutor(2, thread_name_prefix="corners")


@cache
def _pair_offsets(width: int) -> Ints:
    """(N_ANGLES, 256, 2): the descriptor's pairs turned to N_ANGLES directions, as offsets in an image that wide."""
    pairs = np.load(str(files("lodelight") / "data" / "descriptor_pairs.npy")).astype(np.float64)
    angle = 2.0 * np.pi * np.arange(N_ANGLES) / N_ANGLES
    c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    x, y = pairs[None, :, 0::2], pairs[None, :, 1::2]
    offsets: Ints = (np.rint(s * x + c * y) * width + np.rint(c * x - s * y)).astype(np.int32)
    return offsets


@kernel
def orientations(image: Bytes, px: Ints) -> ArrayF32:
    """(N,) rad: direction from the patch's centre to its intensity centroid, over a disk."""
    half_width = np.empty(PATCH_RADIUS + 1, np.int32)
    for v in range(PATCH_RADIUS + 1):
        half_width[v] = int(math.sqrt(PATCH_RADIUS * PATCH_RADIUS - v * v) + 0.5)
    out = np.empty(len(px), np.float32)
    for i in range(len(px)):
        x, y = px[i, 0], px[i, 1]
        m10 = m01 = 0
        for v in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            row = image[y + v]
            total = 0
            for u in range(-half_width[abs(v)], half_width[abs(v)] + 1):
                value = int(row[x + u])
                m10 += u * value
                total += value
            m01 += v * total
        out[i] = math.atan2(float(m01), float(m10))
    return out


@kernel
def describe(smooth: Bytes, px: Ints, angle: ArrayF32, pair_offsets: Ints) -> Words:
    """(N, 4) uint64 descriptors: one bit a pair, set where the first pixel of the pair is darker."""
    out = np.zeros((len(px), 4), np.uint64)
    pixels = smooth.reshape(-1)
    for i in range(len(px)):
        centre = px[i, 1] * smooth.shape[1] + px[i, 0]
        offsets = pair_offsets[int(np.rint(angle[i] * (N_ANGLES / (2.0 * math.pi)))) % N_ANGLES]
        for word in range(4):
            bits = np.uint64(0)
            for k in range(64):
                p = offsets[64 * word + k]
                darker = pixels[np.uint64(centre + p[0])] < pixels[np.uint64(centre + p[1])]
                bits |= np.uint64(darker) << np.uint64(k)
            out[i, word] = bits
    return out


@kernel
def refine_corners(image: Bytes, px: Ints) -> Array:
    """(N, 2) sub-pixel corners: the point to which the gradients around are most nearly perpendicular.

    A corner that would move by more than a pixel, or has no two directions of gradient, stays where it is.
    """
    radius = 3
    out = np.empty((len(px), 2))
    for i in range(len(px)):
        x0, y0 = px[i, 0], px[i, 1]
        out[i, 0], out[i, 1] = x0, y0
        a = b = c = r = s = 0.0
        for v in range(-radius, radius + 1):
            for u in range(-radius, radius + 1):
                gx = 0.5 * (float(image[y0 + v, x0 + u + 1]) - float(image[y0 + v, x0 + u - 1]))
                gy = 0.5 * (float(image[y0 + v + 1, x0 + u]) - float(image[y0 + v - 1, x0 + u]))
                w = math.exp(-0.5 * (u * u + v * v) / 2.25)
                a += w * gx * gx
                b += w * gx * gy
                c += w * gy * gy
                r += w * gx * (gx * u + gy * v)
                s += w * gy * (gx * u + gy * v)
        det = a * c - b * b
        if det > 1e-3 * (a + c) * (a + c):
            dx, dy = (c * r - b * s) / det, (a * s - b * r) / det
            if dx * dx + dy * dy < 1.0:
                out[i, 0] += dx
                out[i, 1] += dy
    return out
