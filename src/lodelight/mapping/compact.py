"""A map without its dead rows, numbered anew without gaps, in the old order."""

from __future__ import annotations

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.types import AnyArray, Bools, Ints

# Columns that hold row numbers, and of which table.
REFERENCES = {
    "keyframes": {"parent": "keyframes", "first_feature": "features"},
    "features": {"keyframe": "keyframes", "point": "points", "next": "features"},
    "points": {"head": "features", "first_keyframe": "keyframes", "replaced_by": "points"},
    "loops": {"a": "keyframes", "b": "keyframes"},
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
        columns = {column: values[keep[name]] for column, values in map.tables[name].columns.items()}
        if name == "points":
            columns["first_keyframe"] = heir[columns["first_keyframe"]]
        elif name == "loops":
            columns |= _inherited(map, columns, heir)
        for column, target in REFERENCES.get(name, {}).items():
            columns[column] = new_number[target][columns[column]]
        if name == "keyframes":  # also where a keyframe without features has no row to name
            columns["first_feature"] = np.cumsum(columns["n_features"]) - columns["n_features"]
        table.append(int(keep[name].sum()), **columns)
    np.maximum(small.points.first_keyframe, 0, out=small.points.first_keyframe)  # born in a root that is gone
    return small


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
    }


def _numbers(kept: Bools) -> Ints:
    """New number of every old row, -1 for those that go, and -1 at index -1."""
    return np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1).astype(np.int32)


def _inherited(map: Map, loops: dict[str, AnyArray], heir: Ints) -> dict[str, AnyArray]:
    """Loops between living keyframes: T_a_b carried over to the heirs of culled ends by their known offsets."""
    ends = {"a": heir[loops["a"]], "b": heir[loops["b"]], "R": loops["R"].copy(), "p": loops["p"].copy()}
    for i, (a, b) in enumerate(zip(loops["a"].tolist(), loops["b"].tolist(), strict=True)):
        new_a, new_b = int(ends["a"][i]), int(ends["b"][i])
        if (a, b) != (new_a, new_b):
            T_newa_a, T_b_newb = map.pose(new_a).inverse() @ map.pose(a), map.pose(b).inverse() @ map.pose(new_b)
            T_newa_newb = T_newa_a @ SE3(loops["R"][i], loops["p"][i]) @ T_b_newb
            ends["R"][i], ends["p"][i] = T_newa_newb.R, T_newa_newb.t
    return ends
