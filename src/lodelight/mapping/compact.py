"""A map without its dead rows, numbered anew without gaps, in the old order."""

from __future__ import annotations

import numpy as np

from lodelight.mapping.map import Map
from lodelight.types import AnyArray, Bools

# Columns that hold row numbers, and of which table.
REFERENCES = {
    "keyframes": {"parent": "keyframes", "first_feature": "features"},
    "features": {"keyframe": "keyframes", "point": "points", "next": "features"},
    "points": {"head": "features", "first_keyframe": "keyframes", "replaced_by": "points"},
    "loops": {"a": "keyframes", "b": "keyframes"},
}


def compacted(map: Map) -> Map:
    """A copy that holds the keyframes and points that are alive, the features of those keyframes, and the loops
    between them. A point whose first keyframe is gone names the next one that is left.
    """
    keep = _survivors(map)
    new_number = {name: _numbers(kept) for name, kept in keep.items()}
    small = Map(map.rig)
    for name, table in small.tables.items():
        whole = bool(keep[name].all())
        columns = {c: v if whole else v[keep[name]] for c, v in map.tables[name].columns.items()}
        if name == "keyframes":  # also where a keyframe without features has no row to name
            columns["first_feature"] = np.cumsum(columns["n_features"]) - columns["n_features"]
        for column, target in REFERENCES.get(name, {}).items():
            if column == "first_keyframe":
                columns[column] = _at_or_after(columns[column], keep[target])
            elif column != "first_feature" and not keep[target].all():
                columns[column] = new_number[target][columns[column]]
        table.append(len(columns[next(iter(columns))]), **columns)
    return small


def _survivors(map: Map) -> dict[str, Bools]:
    keyframes, loops = map.keyframes.alive, map.loops
    return {name: np.ones(len(table), np.bool_) for name, table in map.tables.items()} | {
        "keyframes": keyframes,
        "features": np.repeat(keyframes, map.keyframes.n_features),
        "points": map.points.alive,
        "loops": keyframes[loops.a] & keyframes[loops.b],
    }


def _numbers(kept: Bools) -> AnyArray:
    """New number of every old row, -1 for those that go, and -1 at index -1."""
    return np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1).astype(np.int32)


def _at_or_after(rows: AnyArray, kept: Bools) -> AnyArray:
    """New numbers of rows or, where they are gone, of the next that is left (of the last, if none follows)."""
    next_left = np.append(np.cumsum(kept) - kept, -1)
    out: AnyArray = np.minimum(next_left[rows], np.count_nonzero(kept) - 1).astype(np.int32)
    return out
