"""A map without its dead rows, numbered anew without gaps, in the old order: as a copy, or in place."""

from __future__ import annotations

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.mapping.table import Table
from lodelight.types import Bools, Ints

# Columns that hold row numbers, and of which table.
REFERENCES = {
    "keyframes": {"parent": "keyframes", "first_feature": "features"},
    "features": {"keyframe": "keyframes", "point": "points", "next": "features"},
    "points": {"head": "features", "first_keyframe": "keyframes", "replaced_by": "points"},
    "loops": {"a": "keyframes", "b": "keyframes"},
    "tag_views": {"keyframe": "keyframes", "tag": "tags"},
}


def compacted(map: Map) -> Map:
    """A copy that holds the keyframes and points that are alive and the features of those keyframes.

    What names a culled keyframe (a loop, a point that was born in it) names its nearest ancestor that is left; a loop
    whose ends come to one keyframe, or whose end has no such ancestor, goes.
    """
    heir = _heirs(map.keyframes.parent, map.keyframes.alive)
    keep = _survivors(map, heir)
    new_number = {name: _numbers(kept) for name, kept in keep.items()}
    small = Map(map.rig)
    for name, table in small.tables.items():
        table.append(int(keep[name].sum()))
        for column, values in map.tables[name].columns.items():
            table.columns[column][:] = values[keep[name]]
    births, first_feature = small.points.first_keyframe, small.keyframes.first_feature
    births[:] = heir[births]
    _inherit(map, small.loops, heir)
    for name, references in REFERENCES.items():
        for column, target in references.items():
            rows = small.tables[name].columns[column]
            rows[:] = new_number[target][rows]
    births[births < 0] = 0  # in a root that is gone
    # counted anew, since a keyframe without features may name a row that is gone
    first_feature[:] = np.cumsum(small.keyframes.n_features) - small.keyframes.n_features
    return small


def squeeze(map: Map) -> Ints:
    """Drop dead points and the features of dead keyframes, in place; keyframes keep their numbers.

    Returns the new number of every old point, -1 where it is gone, and -1 at index -1: whoever keeps points must look
    them up there. Under the map's lock, while nobody keeps rows of features.
    """
    k, f, p = map.keyframes, map.features, map.points
    kept = k.alive[f.keyframe]
    new_row, new_point = _numbers(kept), _numbers(p.alive)
    f.keep(kept)
    p.keep(p.alive)
    f.point[:], f.next[:], p.head[:] = new_point[f.point], new_row[f.next], new_row[p.head]
    k.n_features[~k.alive] = 0
    k.first_feature[:] = np.cumsum(k.n_features) - k.n_features
    return new_point


def _heirs(parent: Ints, alive: Bools) -> Ints:
    """The nearest living one of each keyframe and its ancestors, -1 = none, and -1 at index -1."""
    heir = np.append(np.where(alive, np.arange(len(alive)), parent), -1).astype(np.int32)
    for _ in range(len(alive).bit_length()):  # each round doubles the number of generations
        heir = heir[heir]
    return heir


def _survivors(map: Map, heir: Ints) -> dict[str, Bools]:
    keyframes, a, b = map.keyframes.alive, heir[map.loops.a], heir[map.loops.b]
    return {name: np.ones(len(table), np.bool_) for name, table in map.tables.items()} | {
        "keyframes": keyframes,
        "features": np.repeat(keyframes, map.keyframes.n_features),
        "points": map.points.alive,
        "loops": (a >= 0) & (b >= 0) & (a != b),
        "tag_views": keyframes[map.tag_views.keyframe],
    }


def _numbers(kept: Bools) -> Ints:
    """New number of every old row, -1 for those that go, and -1 at index -1."""
    return np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1).astype(np.int32)


def _inherit(map: Map, loops: Table, heir: Ints) -> None:
    """Carry the measured T_a_b of culled ends over to their heirs, by the offsets that are believed between them."""
    for i, (a, b) in enumerate(zip(loops.a.tolist(), loops.b.tolist(), strict=True)):
        new_a, new_b = int(heir[a]), int(heir[b])
        if (a, b) != (new_a, new_b):
            T_newa_a, T_b_newb = map.pose(new_a).inverse() @ map.pose(a), map.pose(b).inverse() @ map.pose(new_b)
            T_newa_newb = T_newa_a @ SE3(loops.R[i], loops.p[i]) @ T_b_newb
            loops.a[i], loops.b[i], loops.R[i], loops.p[i] = new_a, new_b, T_newa_newb.R, T_newa_newb.t
