"""Bend a map so that its tags are where they are known to be, or each in one place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lodelight.estimation.posegraph import PoseGraph, optimize_pose_graph
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.mapping.local import adjust
from lodelight.mapping.loop_correction import edge_information, median_distance, move_points, present_edges, take_along
from lodelight.mapping.map import Map
from lodelight.mapping.tag_corners import MODEL_PX, tag_world
from lodelight.messages import TagSighting
from lodelight.tags.pose import by_prediction, tag_poses
from lodelight.types import Array, Ints


def correct_by_tags(
    map: Map, orb: OrbConfig, sigma_px: float, iterations: int, stop: Callable[[], bool] | None = None
) -> float:
    """A pose graph of keyframes and tags, then adjustment of everything; returns how far a keyframe moved at most, m.

    iterations : of the adjustment; 0 where the IMU will do it later
    Surveyed tags stay where they are; where there is none, the root does.
    """
    with map.lock:
        moved_m = _spread_error(map, sigma_px / map.rig.cameras[0].camera.focal_px)
        before = map.keyframes.R.copy(), map.keyframes.p.copy()
        everything = map.alive_keyframes
    if not iterations:
        return moved_m
    adjust(map, everything, orb, sigma_px, iterations, stop)
    with map.lock:
        take_along(map, *before)
    return moved_m


def _spread_error(map: Map, sigma_rad: float) -> float:
    keyframes = map.alive_keyframes
    R, p = map.keyframes.R[keyframes], map.keyframes.p[keyframes]
    row = np.full(len(map.keyframes), -1)
    row[keyframes] = np.arange(len(keyframes))
    tags = np.flatnonzero(map.tags.placed)
    node = np.full(len(map.tags), -1)
    node[tags] = len(keyframes) + np.arange(len(tags))
    a, b, n_shared = present_edges(map, keyframes)
    R_ab = R[a].transpose(0, 2, 1) @ R[b]
    p_ab = np.einsum("nji,nj->ni", R[a], p[b] - p[a])
    depth_m = np.array([median_distance(map, int(k)) for k in keyframes])
    information = edge_information(n_shared, depth_m[a], sigma_rad)
    closed = np.flatnonzero(map.keyframes.alive[map.loops.a] & map.keyframes.alive[map.loops.b])
    loop_a, loop_b = row[map.loops.a[closed]], row[map.loops.b[closed]]
    many = np.full(len(closed), 100, np.int32)
    t_a, t_b, t_R, t_p, t_information = _tag_edges(map, row, node)
    surveyed = map.tags.surveyed[tags]
    root_held = (map.keyframes.parent[keyframes] < 0) & ~np.any(surveyed)
    graph = PoseGraph(
        np.concatenate([R, map.tags.R[tags]]),
        np.concatenate([p, map.tags.p[tags]]),
        np.concatenate([root_held, surveyed]),
        np.concatenate([a, loop_a, t_a]).astype(np.int32),
        np.concatenate([b, loop_b, t_b]).astype(np.int32),
        np.concatenate([R_ab, map.loops.R[closed], t_R]),
        np.concatenate([p_ab, map.loops.p[closed], t_p]),
        np.concatenate([information, edge_information(many, depth_m[loop_a], sigma_rad), t_information]),
        np.concatenate([np.zeros(len(a) + len(closed), bool), np.ones(len(t_a), bool)]),
    )
    result = optimize_pose_graph(graph, robust="huber")
    n = len(keyframes)
    move_points(map, keyframes, R, p, result.R[:n], result.p[:n])
    map.keyframes.R[keyframes], map.keyframes.p[keyframes] = result.R[:n], result.p[:n]
    free = tags[~surveyed]
    map.tags.R[free], map.tags.p[free] = result.R[n:][~surveyed], result.p[n:][~surveyed]
    return float(np.linalg.norm(result.p[:n] - p, axis=1).max())


def _tag_edges(map: Map, row: Ints, node: Ints) -> tuple[Ints, Ints, Array, Array, Array]:
    """Measured T_keyframe_tag of every usable view from a living keyframe: its row, the tag's, R, p, information."""
    views, spec = map.tag_views, map.rig.cameras[0]
    edges: list[tuple[int, int, SE3, Array]] = []
    for i in np.flatnonzero(views.usable & map.tags.placed[views.tag]):
        keyframe, tag = int(views.keyframe[i]), int(views.tag[i])
        if not map.keyframes.alive[keyframe]:
            continue
        T_keyframe_cam = SE3(views.R[i], views.p[i]) @ spec.T_body_cam
        expected = (map.pose(keyframe) @ T_keyframe_cam).inverse() @ tag_world(map, tag)
        sigma_px = np.hypot(views.sigma_px[i], MODEL_PX)
        sighting = TagSighting(int(views.t_ns[i]), "", "", views.px[i], sigma_px)
        found = by_prediction(tag_poses(sighting, float(map.tags.size_m[tag]), spec.camera), expected)
        if found is None:
            continue
        turned = np.eye(6)
        turned[3:, 3:] = T_keyframe_cam.R
        covariance = turned @ found.covariance @ turned.T + np.diag([0.01**2] * 3 + [0.005**2] * 3)
        edges.append((int(row[keyframe]), int(node[tag]), T_keyframe_cam @ found.T_cam_tag, np.linalg.inv(covariance)))
    a, b = (np.array([e[k] for e in edges], np.int32) for k in (0, 1))
    R = np.array([e[2].R for e in edges]).reshape(-1, 3, 3)
    p = np.array([e[2].t for e in edges]).reshape(-1, 3)
    return a, b, R, p, np.array([e[3] for e in edges]).reshape(-1, 6, 6)
