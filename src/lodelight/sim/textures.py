"""All pictures of a building in one array, each with its pyramid of halved copies (mip-maps)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lodelight.types import Array, ArrayF32, Bytes

SMALLEST = 2  # px; below it a picture is one grey


@dataclass(frozen=True, eq=False)
class Textures:
    """texels : (M,) uint8, reflectance * 255, all levels of all pictures by rows

    table : (n, 4) int64, per picture: first texel, log2 of the width, log2 of the height, levels
    """

    texels: Bytes
    table: NDArray[np.int64]


def pack(pictures: list[ArrayF32]) -> Textures:
    """Pictures (h, w) in [0, 1], sides any power of two from 2 on."""
    parts: list[Bytes] = []
    table = np.zeros((len(pictures), 4), dtype=np.int64)
    start = 0
    for i, picture in enumerate(pictures):
        h, w = picture.shape
        if w & (w - 1) or h & (h - 1) or min(w, h) < SMALLEST:
            raise ValueError(f"picture {i} is {w}x{h}; its sides must be powers of two")
        levels = min(w, h).bit_length() - SMALLEST.bit_length() + 1
        table[i] = start, w.bit_length() - 1, h.bit_length() - 1, levels
        level = picture
        for _ in range(levels):
            part = np.clip(np.rint(level * 255.0), 0, 255).astype(np.uint8).ravel()
            parts.append(part)
            start += len(part)
            level = 0.25 * (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2])
    return Textures(np.concatenate(parts), table)


def power_of_two(picture: Array | ArrayF32 | Bytes, largest: int = 1024) -> ArrayF32:
    """Resample a picture (grey, [0, 1] or bytes) by areas to the powers of two at or above its sides."""
    image = picture.astype(np.float32) / (255.0 if picture.dtype == np.uint8 else 1.0)
    h, w = (min(largest, max(SMALLEST, 1 << (n - 1).bit_length())) for n in image.shape)
    # Enlarge by whole factors first: then shrinking by areas keeps every edge where it was
    fy, fx = -(-h // image.shape[0]), -(-w // image.shape[1])
    image = np.repeat(np.repeat(image, fy, axis=0), fx, axis=1)
    out: ArrayF32 = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), dtype=np.float32)
    return out
