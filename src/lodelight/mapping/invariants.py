"""What always holds in a map. For `lodelight map check`, for loading, and for the tests of whatever changes a map."""

from __future__ import annotations

import numpy as np

from lodelight.features.shutter import BEYOND
from lodelight.mapping.compact import REFERENCES
from lodelight.mapping.map import Map
from lodelight.types import AnyArray, Bools

# Rotations are products of thousands of others; what rounding leaves of that is near 1e-12, a bug is far above.
ROTATION_TOLERANCE = 1e-6


def problems(map: Map) -> list[str]:
    """Everything that does not hold, one line each: what, and its first rows."""
    return structure(map) or [*_keyframes(map), *_features(map), *_points(map), *_numbers(map)]


def structure(map: Map) -> list[str]:
    """What would lead a loop over the map out of its arrays or round in circles."""
    return _ranges(map) or [*_lists(map), *_cycles(map)]


def _some(what: str, wrong: Bools) -> list[str]:
    rows = np.flatnonzero(wrong)
    if not len(rows):
        return []
    more = f", ... ({len(rows)} in all)" if len(rows) > 5 else ""
    return [f"{what}: {', '.join(str(row) for row in rows[:5])}{more}"]


def _ranges(map: Map) -> list[str]:
    """Row numbers must lie in the table they point into, and keyframes' features lie one range after the other."""
    found = []
    for name, columns in REFERENCES.items():
        for column, target in columns.items():
            rows, n = map.tables[name].columns[column], len(map.tables[target])
            above = rows > n if column == "first_feature" else rows >= n
            found += _some(f"{name} whose {column} is no row of {target}", (rows < -1) | above)
    k = map.keyframes
    found += _some("keyframes with a negative number of features", k.n_features < 0)
    starts = np.cumsum(k.n_features) - k.n_features
    found += _some("keyframes whose features do not follow those of the one before", k.first_feature != starts)
    if not found and int(k.n_features.sum()) != len(map.features):
        found.append(f"{len(map.features)} features, but the keyframes name {int(k.n_features.sum())}")
    return found or _some(
        "features that name another keyframe than the one that names them",
        map.features.keyframe != np.repeat(np.arange(len(k)), k.n_features),
    )


def _lists(map: Map) -> list[str]:
    """Walk all lists at once, from the heads on: each must visit the features that name its point, each once."""
    f, p = map.features, map.points
    visited = np.zeros(len(f), np.bool_)
    wrong = np.zeros(len(p), np.bool_)
    length = np.zeros(len(p), np.int32)
    points, rows = np.arange(len(p)), p.head
    while len(rows := rows[on := rows >= 0]):
        points = points[on]
        wrong[points[visited[rows] | (f.point[rows] != points)]] = True
        fresh = ~visited[rows]
        points, rows = points[fresh], rows[fresh]
        visited[rows] = True
        length[points] += 1
        rows = f.next[rows]
    return [
        *_some("points whose list of features runs into another list or round in a circle", wrong),
        *_some("features that name a point which does not list them", (f.point >= 0) & ~visited),
        *_some("features that name no point but have a next one", (f.point < 0) & (f.next >= 0)),
        *_some("points whose n_obs is not the length of their list", ~wrong & (p.n_obs != length)),
    ]


def _cycles(map: Map) -> list[str]:
    return [
        *_some("keyframes that are their own ancestors", _in_cycle(map.keyframes.parent)),
        *_some("points that were replaced by themselves in the end", _in_cycle(map.points.replaced_by)),
    ]


def _in_cycle(successor: AnyArray) -> Bools:
    """Rows from which following `successor` never ends; each round doubles the step."""
    far = successor.copy()
    for _ in range(len(successor).bit_length()):
        far = np.where(far >= 0, far[far], -1)
    endless: Bools = far >= 0
    return endless


def _keyframes(map: Map) -> list[str]:
    k = map.keyframes
    with np.errstate(invalid="ignore"):
        off = np.abs(np.swapaxes(k.R, 1, 2) @ k.R - np.eye(3)).max(axis=(1, 2), initial=0.0)
    rotation = off <= ROTATION_TOLERANCE
    rotation[rotation] = np.linalg.det(k.R[rotation]) > 0.0
    roots = k.alive & (k.parent < 0)
    return [
        *_some("keyframes whose R is no rotation", ~rotation),
        *_some("keyframes whose parent is dead", k.alive & (k.parent >= 0) & ~k.alive[k.parent]),
        *(_some("keyframes without a parent, where one is the root of all", roots) if roots.sum() > 1 else []),
    ]


def _features(map: Map) -> list[str]:
    k, f = map.keyframes, map.features
    camera = map.rig.cameras[0].camera
    beyond_px = BEYOND * camera.width if map.rig.cameras[0].row_time_s > 0.0 else 0.0
    alive = k.alive[f.keyframe]
    seen = np.flatnonzero(f.point >= 0)
    pairs = f.point[seen].astype(np.int64) * max(len(k), 1) + f.keyframe[seen]
    _, first = np.unique(pairs, return_index=True)
    again = np.ones(len(seen), np.bool_)
    again[first] = False
    return [
        *_some(f"features outside the {camera.width}x{camera.height} image", alive & ~camera.inside(f.px, -beyond_px)),
        *_some("features of dead keyframes that still name a point", ~alive & (f.point >= 0)),
        *_some("features whose keyframe sees the same point twice", np.isin(np.arange(len(f)), seen[again])),
    ]


def _points(map: Map) -> list[str]:
    p = map.points
    return [
        *_some("points alive that no feature sees", p.alive & (p.n_obs == 0)),
        *_some("dead points that features still see", ~p.alive & (p.n_obs > 0)),
        *_some("points alive though another replaced them", p.alive & (p.replaced_by >= 0)),
    ]


def _numbers(map: Map) -> list[str]:
    """Keyframes (a culled one still has a pose) and whatever is alive are made of finite numbers."""
    alive = {"features": map.keyframes.alive[map.features.keyframe], "points": map.points.alive}
    found = []
    for name, table in map.tables.items():
        counts = alive.get(name, np.ones(len(table), np.bool_))
        for column, values in table.columns.items():
            if values.dtype.kind == "f":
                finite = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
                found += _some(f"{name} whose {column} is not finite", counts & ~finite)
    return found
