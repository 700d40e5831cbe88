"""Two maps as one list of rows, in one frame and through one camera, before anything is adjusted."""

from __future__ import annotations

import math

import numpy as np

from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3, carried_covariance
from lodelight.io.rig_toml import format_rig
from lodelight.mapping.compact import REFERENCES, compacted
from lodelight.mapping.map import Map
from lodelight.rig import Rig
from lodelight.types import Ints


def joined(base: Map, other: Map) -> tuple[Map, list[str]]:
    """A new map with the rows of both, those of `other` behind, and the tags that both have under one name.

    Poses, points and parents are as they were: two trees, in two frames. Views of a tag whose size the maps do not
    agree on are left unused on the side of `other`.
    """
    both = Map(base.rig)
    shift = {name: len(table) for name, table in base.tables.items()}
    tag_row, new_tags, shared, misfits = _tag_rows(base, other)
    for name, table in both.tables.items():
        columns = other.tables[name].columns
        kept = new_tags if name == "tags" else np.arange(len(other.tables[name]))
        table.append(shift[name] + len(kept))
        for column, values in table.columns.items():
            values[: shift[name]] = base.tables[name].columns[column]
            rows = columns[column][kept]
            target = REFERENCES.get(name, {}).get(column)
            if target == "tags":
                rows = tag_row[rows]
            elif target:
                rows = np.where(rows >= 0, rows + shift[target], rows)
            values[shift[name] :] = rows
    theirs = np.arange(len(both.tag_views)) >= shift["tag_views"]
    both.tag_views.usable[theirs & np.isin(both.tag_views.tag, misfits)] = False
    return both, shared


def _tag_rows(base: Map, other: Map) -> tuple[Ints, Ints, list[str], Ints]:
    """Row in the joined map of each tag of `other`, which of them are new, names of those shared, rows of misfits."""
    known = {bytes(name): row for row, name in enumerate(base.tags.name)}
    row_of: list[int] = []
    new: list[int] = []
    shared: list[str] = []
    misfits: list[int] = []
    for i, name in enumerate(other.tags.name):
        row = known.get(bytes(name))
        if row is None:
            row = len(base.tags) + len(new)
            new.append(i)
        elif math.isclose(base.tags.size_m[row], other.tags.size_m[i], rel_tol=0.02):
            shared.append(bytes(name).decode())
        else:
            misfits.append(row)
        row_of.append(row)
    return np.array(row_of, np.int32), np.array(new, np.int32), shared, np.array(misfits, np.int32)


def lay(map: Map, first_keyframe: int, first_point: int, first_tag: int, T_new_old: SE3) -> None:
    """Move the rows from those on, which came from another map; their covariances turn with them."""
    turn = np.eye(6)
    turn[3:, 3:] = T_new_old.R
    k, p, t = map.keyframes, map.points, map.tags
    k.R[first_keyframe:] = T_new_old.R @ k.R[first_keyframe:]
    k.p[first_keyframe:] = T_new_old @ k.p[first_keyframe:]
    k.covariance[first_keyframe:] = turn @ k.covariance[first_keyframe:] @ turn.T
    p.xyz[first_point:] = T_new_old @ p.xyz[first_point:]
    p.normal[first_point:] = p.normal[first_point:] @ T_new_old.R.T
    t.R[first_tag:], t.p[first_tag:] = T_new_old.R @ t.R[first_tag:], T_new_old @ t.p[first_tag:]
    t.covariance[first_tag:] = turn @ t.covariance[first_tag:] @ turn.T


def through(map: Map, rig: Rig, orb: OrbConfig) -> Map:
    """A copy without dead rows, as if camera 0 of `rig` had seen it all: pixels along the same rays.

    Each keyframe's camera stays where it was, so its body moves to where that rig has it. What lies outside the other
    image is lost. Octaves follow the focal length, so that a patch keeps its size in metres.
    """
    seen = compacted(map)
    if format_rig(map.rig) == format_rig(rig):
        return seen
    was, now = map.rig.cameras[0], rig.cameras[0]
    f, k, v = seen.features, seen.keyframes, seen.tag_views
    ray, valid = was.camera.unproject(f.px)
    px, visible = now.camera.project(ray)
    lost = np.flatnonzero(~(valid & visible & now.camera.inside(px))).astype(np.int32)
    f.px[:] = np.where(np.isfinite(px), px, 0.0)
    coarser = round(math.log(now.camera.focal_px / was.camera.focal_px) / math.log(orb.scale_factor))
    f.octave[:] = np.clip(f.octave + coarser, 0, orb.n_levels - 1)
    T_old_new = was.T_body_cam @ now.T_body_cam.inverse()
    for i in range(len(k)):
        T_world_old = seen.pose(i)
        seen.set_pose(i, T_world_old @ T_old_new)
        k.covariance[i] = carried_covariance(T_world_old, k.covariance[i].copy(), seen.pose(i))
    for table in (v, seen.loops):
        for i in range(len(table)):
            T = T_old_new.inverse() @ SE3(table.R[i].copy(), table.p[i].copy()) @ T_old_new
            table.R[i], table.p[i] = T.R, T.t
    for i in range(len(v)):
        corners, good = was.camera.unproject(v.px[i])
        v.px[i], inside = now.camera.project(corners)
        v.usable[i] &= bool(good.all() and inside.all() and now.camera.inside(v.px[i]).all())
    seen.rig = rig
    return _without_features(seen, rig, lost, orb)


def _without_features(map: Map, rig: Rig, lost: Ints, orb: OrbConfig) -> Map:
    """Drop feature rows; points that nobody else saw go with them."""
    map.unlink(lost)
    gone = np.zeros(len(map.features), np.bool_)
    gone[lost] = True
    new_row = np.append(np.where(gone, -1, np.cumsum(~gone) - 1), -1).astype(np.int32)
    out = Map(rig)
    for name, table in out.tables.items():
        kept = ~gone if name == "features" else np.ones(len(map.tables[name]), np.bool_)
        table.append(int(kept.sum()))
        for column, values in table.columns.items():
            rows = map.tables[name].columns[column][kept]
            values[:] = new_row[rows] if REFERENCES.get(name, {}).get(column) == "features" else rows
    k = out.keyframes
    k.n_features[:] = np.bincount(out.features.keyframe, minlength=len(k))
    k.first_feature[:] = np.cumsum(k.n_features) - k.n_features
    out.refresh_points(out.alive_points, orb.scale_factor, orb.n_levels)
    return compacted(out)
