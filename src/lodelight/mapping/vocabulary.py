"""Visual words: a descriptor's nearest among the 8192 that ship with this project.

The words are sorted into cells, and a descriptor is compared with the words of its nearest few cells alone: the same
word as by comparing all of them for nine descriptors in ten, in a fifth of the time. Why so many, and why no tree:
docs/decisions/places.md. Trained by tools/train_vocabulary.py.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from lodelight.compiled import kernel
from lodelight.features.hamming import popcount
from lodelight.types import AnyArray, ArrayF32, Ints, Words

PROBES = 8


@kernel
def nearest_words(desc: Words, cells: Words, first: Ints, centres: Words, probes: int) -> Ints:
    """Nearest centre (N,) of each descriptor (N, 4), looked for in its `probes` nearest cells.

    cells (C, 4); centres (W, 4) in the order of their cells; cell c holds centres first[c] to first[c + 1].
    """
    out = np.empty(len(desc), np.int32)
    distance = np.empty(len(cells), np.int32)
    for i in range(len(desc)):
        d0, d1, d2, d3 = desc[i, 0], desc[i, 1], desc[i, 2], desc[i, 3]
        for c in range(len(cells)):
            w = cells[c]
            distance[c] = popcount(d0 ^ w[0]) + popcount(d1 ^ w[1]) + popcount(d2 ^ w[2]) + popcount(d3 ^ w[3])
        best, nearest = 1 << 30, 0
        for _ in range(probes):
            c = int(np.argmin(distance))
            distance[c] = 1 << 20
            for j in range(first[c], first[c + 1]):
                w = centres[j]
                d = popcount(d0 ^ w[0]) + popcount(d1 ^ w[1]) + popcount(d2 ^ w[2]) + popcount(d3 ^ w[3])
                if d < best:
                    best, nearest = d, j
        out[i] = nearest
    return out


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """W words in C cells.

    centres : (W, 4) uint64, the words' descriptors, in the order of their cells
    cells : (C, 4) uint64, the cells' own
    first : (C + 1,) int32, cell c holds centres first[c] to first[c + 1]
    idf : (W,) float32, log of how rarely an image has the word
    """

    centres: Words
    cells: Words
    first: Ints
    idf: ArrayF32

    def __len__(self) -> int:
        return len(self.centres)

    def words(self, desc: Words) -> Ints:
        """The word (N,) int32 of each descriptor (N, 4) uint64."""
        return nearest_words(
            np.ascontiguousarray(desc), self.cells, self.first, self.centres, min(PROBES, len(self.cells))
        )

    def save(self, path: Path) -> None:
        np.savez_compressed(
            path, centres=self.centres, cells=self.cells, first=self.first, idf=self.idf.astype(np.float16)
        )

    @staticmethod
    def load(path: Path) -> Vocabulary:
        with np.load(path) as columns:
            column: dict[str, AnyArray] = {name: columns[name] for name in ("centres", "cells", "first", "idf")}
        return Vocabulary(column["centres"], column["cells"], column["first"], column["idf"].astype(np.float32))

    @staticmethod
    @functools.cache
    def shipped() -> Vocabulary:
        """The one this project ships, loaded once."""
        return Vocabulary.load(Path(str(files("lodelight") / "data" / "vocabulary.npz")))
