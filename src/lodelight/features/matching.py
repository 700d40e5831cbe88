"""Descriptors to matches: near a predicted pixel, or anywhere in the image.

Every search returns, for each query, a feature index or -1, and no feature twice: of two queries that want the same
feature the nearer in Hamming distance has it.
"""

from __future__ import annotations

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.features.features import Features
from lodelight.features.hamming import hamming
from lodelight.types import Array, ArrayF32, Bools, Ints, Words

HAMMING_STRICT = 50  # without a prediction of where to look
HAMMING_LOOSE = 100  # within a small window; the mean of unrelated patches is near 128 of 256 bits
CELL_PX = 16
_TURN_BINS = 30


class FeatureIndex:
    """Features of one frame in square cells, for searches around pixels."""

    def __init__(self, features: Features, width: int, height: int) -> None:
        self.features = features
        self._columns = width // CELL_PX + 1
        self._rows = height // CELL_PX + 1
        self._start, self._order = _bucket(features.px, self._columns, self._rows)

    def search(
        self,
        px: Array,
        radius_px: Array,
        octave_range: tuple[Ints, Ints],
        desc: Words,
        free: Bools | None = None,
        max_hamming: int = HAMMING_LOOSE,
        ratio: float = 1.0,
    ) -> Ints:
        """Best feature within radius_px (M,) of px (M, 2) and of an octave in range (both ends meant), or -1.

        free : (N,) features that may be taken, all where None
        ratio : a match must be better than `ratio` times the second best of the same octave
        """
        f = self.features
        if free is None:
            free = np.ones(len(f), np.bool_)
        return _search_near(
            px, radius_px, octave_range[0], octave_range[1], desc, f.px, f.octave, f.desc, free,
            self._start, self._order, self._columns, self._rows, max_hamming, ratio,
        )  # fmt: skip


def match_descriptors(query: Words, train: Words, max_hamming: int = HAMMING_STRICT, ratio: float = 0.75) -> Ints:
    """For every query (M, 4) the train row that is nearest, mutually so, and passes the ratio test, or -1."""
    if len(query) == 0 or len(train) == 0:
        return np.full(len(query), -1, np.int32)
    return _match_all(query, train, max_hamming, ratio)


def consistent_turn(angle_a: ArrayF32, angle_b: ArrayF32) -> Bools:
    """Which pairs of patch orientations (rad) turn alike: those in the three fullest of 30 bins of the difference.

    Source: Mur-Artal et al. 2015 describe this rotation histogram.
    """
    if len(angle_a) == 0:
        return np.zeros(0, np.bool_)
    turn = (angle_a - angle_b) / (2.0 * np.pi) % 1.0
    bins = np.minimum((turn * _TURN_BINS).astype(int), _TURN_BINS - 1)
    counts = np.bincount(bins, minlength=_TURN_BINS)
    best = np.argsort(-counts, kind="stable")[:3]
    best = best[counts[best] >= 0.1 * counts[best[0]]]
    keep: Bools = np.isin(bins, best)
    return keep


@kernel
def _bucket(px: ArrayF32, columns: int, rows: int) -> tuple[Ints, Ints]:
    """Rows of px sorted by cell: cell c holds order[start[c]:start[c + 1]]."""
    n = len(px)
    cell = np.empty(n, np.int32)
    start = np.zeros(columns * rows + 1, np.int32)
    for i in range(n):
        x = min(max(int(px[i, 0] / CELL_PX), 0), columns - 1)
        y = min(max(int(px[i, 1] / CELL_PX), 0), rows - 1)
        cell[i] = y * columns + x
        start[cell[i] + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    fill = start.copy()
    order = np.empty(n, np.int32)
    for i in range(n):
        order[fill[cell[i]]] = i
        fill[cell[i]] += 1
    return start, order


@kernel
def _search_near(
    px: Array, radius_px: Array, octave_min: Ints, octave_max: Ints, desc: Words,
    f_px: ArrayF32, f_octave: Ints, f_desc: Words, free: Bools,
    start: Ints, order: Ints, columns: int, rows: int, max_hamming: int, ratio: float,
) -> Ints:  # fmt: skip
    owner = np.full(len(f_px), -1, np.int32)
    owner_distance = np.empty(len(f_px), np.int32)
    match = np.full(len(px), -1, np.int32)
    for i in range(len(px)):
        r = radius_px[i]
        x0 = max(math.floor((px[i, 0] - r) / CELL_PX), 0)
        x1 = min(math.floor((px[i, 0] + r) / CELL_PX), columns - 1)
        y0 = max(math.floor((px[i, 1] - r) / CELL_PX), 0)
        y1 = min(math.floor((px[i, 1] + r) / CELL_PX), rows - 1)
        if x1 < x0:
            continue
        best, best_distance = -1, max_hamming + 1
        second_distance, second_octave = 257, -1
        for y in range(y0, y1 + 1):
            for at in range(start[y * columns + x0], start[y * columns + x1 + 1]):
                j = order[at]
                if not free[j] or f_octave[j] < octave_min[i] or f_octave[j] > octave_max[i]:
                    continue
                dx, dy = f_px[j, 0] - px[i, 0], f_px[j, 1] - px[i, 1]
                if dx * dx + dy * dy > r * r:
                    continue
                distance = hamming(desc[i], f_desc[j])
                if distance < best_distance:
                    if best >= 0:
                        second_distance, second_octave = best_distance, f_octave[best]
                    best, best_distance = j, distance
                elif distance < second_distance:
                    second_distance, second_octave = distance, f_octave[j]
        if best < 0 or (second_octave == f_octave[best] and best_distance > ratio * second_distance):
            continue
        if owner[best] >= 0:
            if owner_distance[best] <= best_distance:
                continue
            match[owner[best]] = -1
        owner[best], owner_distance[best], match[i] = i, best_distance, best
    return match


@kernel
def _match_all(query: Words, train: Words, max_hamming: int, ratio: float) -> Ints:
    n, m = len(query), len(train)
    best = np.full(n, -1, np.int32)
    best_distance = np.full(n, 257, np.int32)
    second_distance = np.full(n, 257, np.int32)
    back = np.full(m, -1, np.int32)
    back_distance = np.full(m, 257, np.int32)
    for i in range(n):
        for j in range(m):
            distance = hamming(query[i], train[j])
            if distance < best_distance[i]:
                second_distance[i] = best_distance[i]
                best_distance[i], best[i] = distance, j
            elif distance < second_distance[i]:
                second_distance[i] = distance
            if distance < back_distance[j]:
                back_distance[j], back[j] = distance, i
    match = np.full(n, -1, np.int32)
    for i in range(n):
        j = best[i]
        near = best_distance[i] <= max_hamming and best_distance[i] <= ratio * second_distance[i]
        if near and back[j] == i:
            match[i] = j
    return match
