"""Corners of tags in bundle adjustment: the best points there are, seen to a fraction of a pixel and never mistaken.

Corners of a surveyed tag are points that are not moved: they tie the map to the world, and where they are seen nothing
else has to hold it. Corners of other tags are points like any other, which two visits share whatever they look like.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.estimation.bundle_problem import BundleProblem
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.types import AnyArray, Array, Ints

MODEL_PX = 0.3  # error of the lens model and of a sheet that is not quite flat, added to every corner's sigma


def with_tag_corners(map: Map, problem: BundleProblem, keyframes: Ints, window: Ints) -> BundleProblem:
    """The problem with the corners of all placed tags that its keyframes see, after its own points and observations.

    keyframes : ids of the problem's rows, rising; window : those that may move. The root moves too where a surveyed
    tag is seen from the window.
    """
    views, tags = map.tag_views, map.tags
    rows = np.flatnonzero(views.usable & views.own & map.keyframes.alive[views.keyframe] & tags.placed[views.tag])
    rows = rows[np.isin(views.keyframe[rows], keyframes)]
    if not len(rows):
        return problem
    seen, which = np.unique(views.tag[rows], return_inverse=True)
    n_views, n_points, n_observed = len(rows), len(problem.xyz), len(problem.px)
    xyz = np.concatenate([tag_world(map, int(tag)) @ tag_corners(float(tags.size_m[tag])) for tag in seen])
    point = n_points + 4 * which[:, None] + np.arange(4)
    survey_px = np.where(tags.surveyed[views.tag[rows]], _survey_px(map, rows), 0.0)
    sigma_px = np.sqrt(views.sigma_px[rows] ** 2 + MODEL_PX**2 + survey_px[:, None] ** 2)
    held = np.zeros(n_points, bool) if problem.fixed_points is None else problem.fixed_points
    fixed = np.array(problem.fixed, bool)
    tying = tags.surveyed[views.tag[rows]] & np.isin(views.keyframe[rows], window)
    if tying.any():
        fixed &= ~np.isin(keyframes, window)
    weight = np.ones(n_observed) if problem.weight is None else problem.weight
    nothing = np.zeros(4 * n_views)
    return replace(
        problem,
        fixed=fixed,
        xyz=np.concatenate([problem.xyz, xyz]),
        keyframe=_joined(problem.keyframe, np.repeat(np.searchsorted(keyframes, views.keyframe[rows]), 4)),
        point=_joined(problem.point, point.ravel()),
        px=np.concatenate([problem.px, views.px[rows].reshape(-1, 2)]),
        sigma_px=np.concatenate([problem.sigma_px, sigma_px.ravel()]),
        inv_depth=np.concatenate([problem.inv_depth, nothing]),
        sigma_inv_depth=np.concatenate([problem.sigma_inv_depth, nothing]),
        weight=np.concatenate([weight, np.ones(4 * n_views)]),
        fixed_points=np.concatenate([held, np.repeat(tags.surveyed[seen], 4)]),
    )


def tag_world(map: Map, tag: int) -> SE3:
    """Where a placed tag hangs, in the map's frame."""
    return SE3(map.tags.R[tag].copy(), map.tags.p[tag].copy())


def _joined(a: AnyArray, b: AnyArray) -> Ints:
    return np.concatenate([a, b]).astype(np.int32)


def _survey_px(map: Map, rows: AnyArray) -> Array:
    """(N,) what the survey's error amounts to in each view's image."""
    px, tag = map.tag_views.px[rows], map.tag_views.tag[rows]
    side_px = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2).max(axis=1)
    sigma_m = np.sqrt(np.trace(map.tags.covariance[tag][:, 3:, 3:], axis1=1, axis2=2) / 3.0)
    out: Array = side_px * sigma_m / map.tags.size_m[tag]
    return out
