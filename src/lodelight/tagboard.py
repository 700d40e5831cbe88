"""A board of printed tags, to calibrate a camera with: what is on it and where.

Board frame: origin at the upper left corner of the first tag, x to the right, y down, z into the board.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from lodelight.errors import ConfigError
from lodelight.types import Array

TEXT = re.compile(
    r"(?P<family>[a-z0-9_]+):(?P<columns>[0-9]{1,2})x(?P<rows>[0-9]{1,2}):(?P<size>[0-9.]+)/(?P<gap>[0-9.]+)mm"
)


@dataclass(frozen=True)
class TagBoard:
    """columns x rows tags of size_m, gap_m apart, numbered from 0 row by row. The default fills A4."""

    family: str = "tag36h11"
    columns: int = 6
    rows: int = 8
    size_m: float = 0.024
    gap_m: float = 0.0072

    @staticmethod
    def parse(text: str) -> TagBoard:
        """From `tag36h11:6x8:24/7.2mm`. Raises ConfigError on another text."""
        found = TEXT.fullmatch(text)
        try:
            family, columns, rows, size, gap = found.groups() if found else ()
            board = TagBoard(family, int(columns), int(rows), 1e-3 * float(size), 1e-3 * float(gap))
        except ValueError:
            raise ConfigError(
                f"board {text!r} is unclear; write family:columns x rows:size/gap, as {TagBoard()}"
            ) from None
        if min(board.columns, board.rows) < 1 or not 0.001 <= board.size_m <= 5.0 or not board.gap_m >= 0.0:
            raise ConfigError(f"board {text!r}: it needs a tag, and tags of 1 mm to 5 m")
        return board

    def __str__(self) -> str:
        return f"{self.family}:{self.columns}x{self.rows}:{1e3 * self.size_m:g}/{1e3 * self.gap_m:g}mm"

    @property
    def width_m(self) -> float:
        return self.columns * self.size_m + (self.columns - 1) * self.gap_m

    @property
    def height_m(self) -> float:
        return self.rows * self.size_m + (self.rows - 1) * self.gap_m

    @property
    def numbers(self) -> range:
        return range(self.columns * self.rows)

    @property
    def upper_left_m(self) -> Array:
        """(N, 2) of each tag's upper left corner."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        out: Array = np.stack([column, row], axis=1) * (self.size_m + self.gap_m)
        return out

    def corners(self, number: int) -> Array:
        """(4, 3) m of a tag's corners, in the order of `anchors.tag_corners`."""
        x, y = self.upper_left_m[number]
        s = self.size_m
        return np.array([[x, y + s, 0.0], [x + s, y + s, 0.0], [x + s, y, 0.0], [x, y, 0.0]])
