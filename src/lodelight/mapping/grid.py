"""An occupancy grid of a map of points: what stands in a robot's way, and where the cameras looked through.

Every sighting is a ray from a camera to a point. Space is counted in boxes as wide as a cell and 0.2 m high: a box
is hit where rays end and missed where they pass. A cell is occupied where one of its boxes is, free where none is and
at least one was looked through (by four rays, if none ended there), and else unknown: so do blank walls stay.
Source: Moravec and Elfes 1985; hit and miss probabilities of OctoMap, Hornung et al. 2013.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.errors import ConfigError
from lodelight.io.occupancy import FREE, OCCUPIED, UNKNOWN
from lodelight.types import AnyArray, Array, Ints

BOX_HEIGHT_M = 0.2
LOG_ODDS_HIT, LOG_ODDS_MISS = math.log(0.7 / 0.3), math.log(0.4 / 0.6)
LOG_ODDS_OCCUPIED, LOG_ODDS_FREE = math.log(0.65 / 0.35), math.log(0.196 / 0.804)  # map_server's own thresholds
CLEARANCE_CELLS = 2.0  # a ray stops short of its point by this: points err, and a slant ray grazes its own wall
MAX_BOXES = 50_000_000  # 400 MB of counts


@dataclass(frozen=True, eq=False)
class Grid:
    """Seen from above, in the map's frame turned so that up is z.

    cells : (rows, columns) int8 of UNKNOWN, FREE, OCCUPIED; row 0 has the lowest y
    origin_xy_m : outer corner of the first cell; floor_m : height of the floor; R_grid_map : that turn
    """

    cells: AnyArray
    resolution_m: float
    origin_xy_m: tuple[float, float]
    floor_m: float
    R_grid_map: Array


@kernel
def _count(centres: Array, points: Array, size_m: Array, range_m: float, hits: Ints, misses: Ints) -> None:
    """Walk every ray in steps of half a cell, in coordinates whose origin is the corner of the first box."""
    layers, rows, columns = hits.shape
    for i in range(len(centres)):
        direction = points[i] - centres[i]
        length = math.sqrt((direction**2).sum())
        steps = int((min(length - CLEARANCE_CELLS * size_m[0], range_m)) / (0.5 * size_m[0]))
        last = -1
        for step in range(steps + 1):
            at = centres[i] + direction * (step * 0.5 * size_m[0] / length)
            x, y, z = math.floor(at[0] / size_m[0]), math.floor(at[1] / size_m[1]), math.floor(at[2] / size_m[2])
            if 0 <= x < columns and 0 <= y < rows and 0 <= z < layers:
                box = (z * rows + y) * columns + x
                if box != last:
                    misses[z, y, x] += 1
                last = box
        if length <= range_m:
            at = points[i]
            x, y, z = math.floor(at[0] / size_m[0]), math.floor(at[1] / size_m[1]), math.floor(at[2] / size_m[2])
            if 0 <= x < columns and 0 <= y < rows and 0 <= z < layers:
                hits[z, y, x] += 1


def occupancy_grid(
    centres: Array,
    points: Array,
    up: Array,
    *,
    resolution_m: float = 0.05,
    band_m: tuple[float, float] = (0.1, 1.8),
    floor_m: float | None = None,
    range_m: float = 10.0,
) -> Grid:
    """Count rays from camera centres (N, 3) to points (N, 3) m, row by row, in the band of heights above the floor.

    up : unit (3,) in their frame; floor_m : the floor's height along it, by default that of the lowest points seen
    range_m : what is farther from its camera is too uncertain to stand anywhere
    Raises ConfigError where nothing is in the band, or the grid would be too large.
    """
    R_grid_map = _turn_up(up)
    centres, points = centres @ R_grid_map.T, points @ R_grid_map.T
    near = np.linalg.norm(points - centres, axis=1) <= range_m
    if not near.any():
        raise ConfigError(f"no point lies within {range_m:g} m of a camera that sees it; choose a larger range")
    if floor_m is None:
        floor_m = _floor(points[near, 2], centres[near, 2])
    bottom, top = floor_m + band_m[0], floor_m + band_m[1]
    standing = points[near & (points[:, 2] >= bottom) & (points[:, 2] < top)]
    if not len(standing):
        raise ConfigError(f"no point lies {band_m[0]:g} to {band_m[1]:g} m above the floor at {floor_m:.2f} m")
    covered = np.vstack([standing, centres[near]])[:, :2]
    low = np.floor(covered.min(axis=0) / resolution_m).astype(np.int64) - 1
    columns, rows = np.floor(covered.max(axis=0) / resolution_m).astype(np.int64) + 2 - low
    layers = math.ceil((top - bottom) / BOX_HEIGHT_M)
    if layers * int(rows) * int(columns) > MAX_BOXES:
        raise ConfigError(
            f"a grid of {columns} x {rows} cells is too large; choose a coarser resolution than {resolution_m:g} m"
        )
    corner = np.append(low * resolution_m, bottom)
    size_m = np.array([resolution_m, resolution_m, (top - bottom) / layers])
    hits, misses = np.zeros((2, layers, rows, columns), np.int32)
    _count(centres - corner, points - corner, size_m, range_m, hits, misses)
    log_odds = hits * LOG_ODDS_HIT + misses * LOG_ODDS_MISS
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    cells[(log_odds < LOG_ODDS_FREE).any(axis=0)] = FREE
    cells[(log_odds > LOG_ODDS_OCCUPIED).any(axis=0)] = OCCUPIED
    return Grid(cells, resolution_m, (float(corner[0]), float(corner[1])), floor_m, R_grid_map)


def _turn_up(up: Array) -> Array:
    """The smallest rotation that takes a unit vector to z."""
    axis = np.array([up[1], -up[0], 0.0])  # up x z
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-12:
        return np.diag([1.0, 1.0, 1.0]) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    x, y, _ = axis / sine
    K = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    out: Array = np.eye(3) + sine * K + (1.0 - cosine) * K @ K
    return out


def _floor(heights: Array, camera_heights: Array) -> float:
    """Where the lowest points lie, leaving one in fifty of those below the cameras to chance."""
    below = heights[heights < np.median(camera_heights)]
    return float(np.percentile(below if len(below) else heights, 2))
