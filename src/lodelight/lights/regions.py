"""Where in an image lights may be: striped or not, whole or cut by the border; the receiver judges them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lodelight.compiled import kernel
from lodelight.types import AnyArray, Bytes

COLUMNS = 4  # of the image that one column of the mask stands for
LEAST_ROWS = 12  # a light lower than this has no stripes to read
LEAST_DN = 8.0  # above the background; below it stripes drown in the steps of eight bits
LAST_LEVEL_DN = 160.0


@dataclass(frozen=True)
class Region:
    """Rows [top, bottom) and columns [left, right) in px that are brighter than the background by level_dn."""

    top: int
    bottom: int
    left: int
    right: int
    level_dn: float
    background_dn: float
    noise_dn: float

    @property
    def rows(self) -> int:
        return self.bottom - self.top

    @property
    def columns(self) -> int:
        return self.right - self.left

    def touches_border(self, shape: tuple[int, ...]) -> bool:
        return self.top <= 0 or self.left <= 0 or self.bottom >= shape[0] or self.right >= shape[1]


def find_regions(image: Bytes, period_rows: float) -> list[Region]:
    """Bright spots of an image (H, W) whose stripes, if they have any, are at most `period_rows` apart.

    Stripes are merged by closing along the columns over one period. What is one spot at a low level and several,
    each higher than a period, at a higher one was several lights whose wings meet: it is parted.
    """
    sample = image[::8, ::8]
    background = float(np.median(sample))
    noise = max(1.4826 * float(np.median(np.abs(sample.astype(np.float64) - background))), 0.7)
    bright = _column_maxima(image)
    level = max(LEAST_DN, 6.0 * noise)
    close = cv2.getStructuringElement(cv2.MORPH_RECT, (1, 2 * int(np.ceil(0.5 * period_rows)) + 1))
    least = max(LEAST_ROWS, round(period_rows))
    boxes = _parted(bright, (0, 0), background, level, close, least)
    return [Region(*box, level_dn=at, background_dn=background, noise_dn=noise) for box, at in boxes]


Box = tuple[int, int, int, int]


def _parted(
    bright: Bytes, origin: tuple[int, int], background: float, level: float, close: AnyArray, least: int
) -> list[tuple[Box, float]]:
    """Boxes (top, bottom, left, right; px) of the spots in a piece of the mask, and the level that set them apart."""
    found = []
    for x, y, w, h in _spots(bright, background + level, close):
        if h < LEAST_ROWS or COLUMNS * w < LEAST_ROWS:
            continue
        piece = bright[y : y + h, x : x + w]
        corner = origin[0] + y, origin[1] + x
        found += _split(piece, corner, background, level, close, least) or [
            ((corner[0], corner[0] + h, COLUMNS * corner[1], COLUMNS * (corner[1] + w)), level)
        ]
    return found


def _split(
    piece: Bytes, corner: tuple[int, int], background: float, level: float, close: AnyArray, least: int
) -> list[tuple[Box, float]]:
    """The parts of a spot, if at some higher level it has several; else none."""
    higher = 2.0 * level
    while higher <= LAST_LEVEL_DN:
        spots = [s for s in _spots(piece, background + higher, close) if s[3] >= least and COLUMNS * s[2] >= least]
        if len(spots) > 1:
            return _parted(piece, corner, background, higher, close, least)
        higher *= 2.0
    return []


def _spots(bright: Bytes, threshold: float, close: AnyArray) -> list[tuple[int, int, int, int]]:
    """x, y, width, height of the components of a mask, its stripes merged."""
    mask = (bright > threshold).astype(np.uint8)
    merged = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, close)
    _, _, stats, _ = cv2.connectedComponentsWithStats(merged, connectivity=8)
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h, _ in stats[1:]]


@kernel
def _column_maxima(image: Bytes) -> Bytes:
    """(H, W / 4): the brightest of every four neighbours in a row."""
    h, w = image.shape[0], image.shape[1] // COLUMNS
    out = np.empty((h, w), np.uint8)
    for y in range(h):
        for x in range(w):
            best = image[y, COLUMNS * x]
            for k in range(1, COLUMNS):
                best = max(best, image[y, COLUMNS * x + k])
            out[y, x] = best
    return out
