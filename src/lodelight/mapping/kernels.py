"""Compiled loops over the map's arrays: observation lists, covisibility, what a point looks like."""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.features.hamming import hamming
from lodelight.types import Array, Bools, Ints, Words


@kernel
def _unlink_one(row: int, point: Ints, next_row: Ints, head: Ints, n_obs: Ints) -> int:
    m = point[row]
    if m < 0:
        return -1
    at = head[m]
    if at == row:
        head[m] = next_row[row]
    else:
        while next_row[at] != row:
            at = next_row[at]
        next_row[at] = next_row[row]
    next_row[row] = -1
    point[row] = -1
    n_obs[m] -= 1
    return int(m)


@kernel
def link(rows: Ints, points: Ints, point: Ints, next_row: Ints, head: Ints, n_obs: Ints, alive: Bools) -> None:
    for i in range(len(rows)):
        row, m = rows[i], points[i]
        before = _unlink_one(row, point, next_row, head, n_obs)
        point[row] = m
        next_row[row] = head[m]
        head[m] = row
        n_obs[m] += 1
        if before >= 0 and n_obs[before] == 0:
            alive[before] = False


@kernel
def fuse(
    old: int, new: int, point: Ints, next_row: Ints, keyframe: Ints, head: Ints, n_obs: Ints, n_visible: Ints,
    n_found: Ints, replaced_by: Ints, alive: Bools,
) -> None:  # fmt: skip
    """`new` takes over the observations of `old`, save in keyframes where it is seen already."""
    row = head[old]
    while row >= 0:
        after = next_row[row]
        _unlink_one(row, point, next_row, head, n_obs)
        at = head[new]
        while at >= 0 and keyframe[at] != keyframe[row]:
            at = next_row[at]
        if at < 0:
            point[row] = new
            next_row[row] = head[new]
            head[new] = row
            n_obs[new] += 1
        row = after
    n_visible[new] += n_visible[old]
    n_found[new] += n_found[old]
    alive[old] = False
    replaced_by[old] = new


@kernel
def join(
    rows: Ints, points: Ints, point: Ints, next_row: Ints, keyframe: Ints, head: Ints, n_obs: Ints, n_visible: Ints,
    n_found: Ints, replaced_by: Ints, alive: Bools,
) -> None:  # fmt: skip
    """Each feature row sees a point: one that saw none is linked; of two points, the one seen less becomes the other.

    A point that was replaced on the way is followed; a dead one, and one that the keyframe sees elsewhere, is left.
    """
    for i in range(len(rows)):
        row, new = rows[i], points[i]
        while replaced_by[new] >= 0:
            new = replaced_by[new]
        if not alive[new] or _sees(keyframe[row], new, next_row, keyframe, head):
            continue
        old = point[row]
        if old < 0:
            point[row] = new
            next_row[row] = head[new]
            head[new] = row
            n_obs[new] += 1
        else:
            if n_obs[old] > n_obs[new]:
                old, new = new, old
            fuse(old, new, point, next_row, keyframe, head, n_obs, n_visible, n_found, replaced_by, alive)


@kernel
def _sees(k: int, m: int, next_row: Ints, keyframe: Ints, head: Ints) -> bool:
    at = head[m]
    while at >= 0:
        if keyframe[at] == k:
            return True
        at = next_row[at]
    return False


@kernel
def unlink(rows: Ints, point: Ints, next_row: Ints, head: Ints, n_obs: Ints, alive: Bools) -> None:
    for row in rows:
        m = _unlink_one(row, point, next_row, head, n_obs)
        if m >= 0 and n_obs[m] == 0:
            alive[m] = False


@kernel
def count_shared(points: Ints, head: Ints, next_row: Ints, keyframe: Ints, n_keyframes: int) -> Ints:
    counts = np.zeros(n_keyframes, np.int32)
    for m in points:
        if m >= 0:
            row = head[m]
            while row >= 0:
                counts[keyframe[row]] += 1
                row = next_row[row]
    return counts


@kernel
def follow_replaced(points: Ints, replaced_by: Ints, alive: Bools) -> Ints:
    out = np.empty(len(points), np.int32)
    for i in range(len(points)):
        m = points[i]
        while m >= 0 and not alive[m]:
            m = replaced_by[m]
        out[i] = m
    return out


@kernel
def refresh_points(
    points: Ints, centres: Array, keyframe: Ints, next_row: Ints, octave: Ints, desc: Words,
    head: Ints, xyz: Array, point_desc: Words, normal: Array, d_min: Array, d_max: Array,
    scale_factor: float, n_levels: int,
) -> None:  # fmt: skip
    """Medoid descriptor (least median distance to the others), mean viewing direction, range of usable distances."""
    rows = np.empty(64, np.int32)
    for m in points:
        n = 0
        row = head[m]
        while row >= 0 and n < len(rows):  # the newest 64 sightings say enough
            rows[n] = row
            n += 1
            row = next_row[row]
        if n == 0:
            continue
        best, best_median = 0, 1 << 30
        if n > 2:
            distances = np.empty(n, np.int32)
            for i in range(n):
                for j in range(n):
                    distances[j] = hamming(desc[rows[i]], desc[rows[j]])
                median = np.sort(distances)[n // 2]
                if median < best_median:
                    best, best_median = i, median
        point_desc[m] = desc[rows[best]]
        sx = sy = sz = 0.0
        for i in range(n):
            c = centres[keyframe[rows[i]]]
            dx, dy, dz = xyz[m, 0] - c[0], xyz[m, 1] - c[1], xyz[m, 2] - c[2]
            d = math.sqrt(dx * dx + dy * dy + dz * dz) + 1e-12
            sx += dx / d
            sy += dy / d
            sz += dz / d
        length = math.sqrt(sx * sx + sy * sy + sz * sz) + 1e-12
        normal[m, 0], normal[m, 1], normal[m, 2] = sx / length, sy / length, sz / length
        # the oldest sighting listed sets the scale: the range at which it would be seen at the outermost octaves
        c = centres[keyframe[rows[n - 1]]]
        dx, dy, dz = xyz[m, 0] - c[0], xyz[m, 1] - c[1], xyz[m, 2] - c[2]
        d = math.sqrt(dx * dx + dy * dy + dz * dz)
        d_max[m] = d * scale_factor ** octave[rows[n - 1]]
        d_min[m] = d_max[m] / scale_factor ** (n_levels - 1)


@kernel
def rows_of_points(points: Ints, head: Ints, next_row: Ints, n_obs: Ints) -> Ints:
    """All feature rows that see the points, point by point."""
    total = 0
    for m in points:
        total += n_obs[m]
    rows = np.empty(total, np.int32)
    n = 0
    for m in points:
        row = head[m]
        while row >= 0:
            rows[n] = row
            n += 1
            row = next_row[row]
    return rows


@kernel
def redundant_share(
    start: int, stop: int, point: Ints, next_row: Ints, octave: Ints, head: Ints, n_obs: Ints, least: int
) -> float:
    """Share of a keyframe's points that at least three other keyframes see at the same or a finer scale.

    least : only points count that so many keyframes see
    """
    total = redundant = 0
    for row in range(start, stop):
        m = point[row]
        if m < 0 or n_obs[m] < least:
            continue
        total += 1
        if n_obs[m] <= 3:
            continue
        others = 0
        at = head[m]
        while at >= 0:
            if at != row and octave[at] <= octave[row] + 1:
                others += 1
            at = next_row[at]
        if others >= 3:
            redundant += 1
    return redundant / max(total, 1)
