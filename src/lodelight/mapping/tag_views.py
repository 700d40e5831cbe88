"""The rows of a map that tell of tags: names, views, and how well a view fits the place of its tag."""

from __future__ import annotations

import math

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.mapping.tag_corners import tag_world
from lodelight.messages import TagSighting
from lodelight.tags.survey import TagView


def tag_key(map: Map, row: int) -> tuple[str, str]:
    """Family and id."""
    family, _, id = tag_name(map, row).partition(" ")
    return family, id


def tag_name(map: Map, row: int) -> str:
    return bytes(map.tags.name[row]).decode()


def find_tag(map: Map, name: str) -> int:
    """Row of a tag by name, -1 where it was never seen."""
    rows = np.flatnonzero(map.tags.name == name.encode())
    return int(rows[0]) if len(rows) else -1


def pose_of_view(map: Map, view: int) -> SE3:
    """T_world_body of the image, as the map stands now."""
    v = map.tag_views
    return map.pose(int(v.keyframe[view])) @ SE3(v.R[view], v.p[view])


def views_of(map: Map, tag: int, most: int, every: bool = False) -> list[TagView]:
    """The usable views of a tag, or every one, evenly thinned to `most`."""
    v = map.tag_views
    rows = np.flatnonzero((v.usable | every) & (v.tag == tag))
    if len(rows) > most:
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]
    T_body_cam, (family, id) = map.rig.cameras[0].T_body_cam, tag_key(map, tag)
    return [
        TagView(TagSighting(int(v.t_ns[i]), family, id, v.px[i], v.sigma_px[i]), pose_of_view(map, i) @ T_body_cam)
        for i in rows.tolist()
    ]


def misfit_px(map: Map, keyframe: int) -> float:
    """Between seen and expected corners of the placed tags in a keyframe: the median of each, the worst of all."""
    v, tags, spec = map.tag_views, map.tags, map.rig.cameras[0]
    T_cam_world = (map.pose(keyframe) @ spec.T_body_cam).inverse()
    worst = 0.0
    for i in np.flatnonzero((v.keyframe == keyframe) & v.own & v.usable & tags.placed[v.tag]).tolist():
        tag = int(v.tag[i])
        corners = tag_world(map, tag) @ tag_corners(float(tags.size_m[tag]))
        px, seen = spec.camera.project(T_cam_world @ corners)
        off = float(np.median(np.linalg.norm(px - v.px[i], axis=1))) if seen.all() else math.inf
        worst = max(worst, off)
    return worst
