"""What a believed loop does to the map: a pose graph spreads the error, doubles become one, all is adjusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.estimation.posegraph import PoseGraph, optimize_pose_graph
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.mapping.local import adjust, fuse_into
from lodelight.mapping.map import Map
from lodelight.mapping.pairs import Pair
from lodelight.mapping.sight import points_of_keyframes
from lodelight.mapping.verification import Verifier
from lodelight.types import Array, Ints

STRONG_SHARED = 100  # points that make two keyframes an edge of the pose graph besides the spanning tree
FUSED_KEYFRAMES = 20  # around either end of the loop, between which doubles are looked for
FUSE_PX = 4.0  # at the finest octave, in which they are looked for


@dataclass(frozen=True)
class Correction:
    """moved_m : farthest that the pose graph moved a keyframe, 0 where the map agreed with the loop beforehand
    fused : points that were found to be another one
    """

    moved_m: float
    fused: int


def correct_loop(
    verifier: Verifier, loop: Pair, drifted: bool, iterations: int, stop: Callable[[], bool] | None = None
) -> Correction:
    """Bend the map so that the loop closes.

    drifted : otherwise the map's poses agree with the loop as they are, and only doubles are fused
    iterations : of the adjustment of all keyframes and points at the end; `stop` is asked between them
    """
    map, orb = verifier.map, verifier.orb
    with map.lock:
        here = verifier.neighbourhood(loop.a, size=FUSED_KEYFRAMES)  # while they are not neighbours yet
        there = verifier.neighbourhood(loop.b, size=FUSED_KEYFRAMES)
        moved_m = spread_error(map, [loop], verifier.sigma_px / verifier.camera.focal_px) if drifted else 0.0
        map.loops.append(1, a=loop.a, b=loop.b, R=loop.T_a_b.R, p=loop.T_a_b.t)
        n_points = np.count_nonzero(map.points.alive)
        unite(map, loop)
        fuse_doubles(map, here, there, orb)
        fused = int(n_points - np.count_nonzero(map.points.alive))
        before = map.keyframes.R.copy(), map.keyframes.p.copy()
        everything = map.alive_keyframes
    if drifted:
        adjust(map, everything, orb, verifier.sigma_px, iterations, stop)
        with map.lock:
            take_along(map, *before)
    return Correction(moved_m, fused)


# -- the pose graph -------------------------------------------------------------------------------------------------


def spread_error(map: Map, loops: Sequence[Pair], sigma_rad: float) -> float:
    """Optimize the pose graph with the new loops and move the points along; returns how far keyframes moved, m."""
    keyframes = map.alive_keyframes
    R, p = map.keyframes.R[keyframes], map.keyframes.p[keyframes]
    a, b, n_shared = present_edges(map, keyframes)
    R_ab = R[a].transpose(0, 2, 1) @ R[b]
    p_ab = np.einsum("nji,nj->ni", R[a], p[b] - p[a])
    row = np.full(len(map.keyframes), -1)
    row[keyframes] = np.arange(len(keyframes))
    closed = np.flatnonzero(map.keyframes.alive[map.loops.a] & map.keyframes.alive[map.loops.b])
    a = np.concatenate([a, row[map.loops.a[closed]], row[[loop.a for loop in loops]]])
    b = np.concatenate([b, row[map.loops.b[closed]], row[[loop.b for loop in loops]]])
    inliers = np.array([loop.inliers for loop in loops])
    n_shared = np.concatenate([n_shared, np.full(len(closed), inliers.min()), inliers])
    depth_m = np.array([median_distance(map, int(k)) for k in keyframes])
    graph = PoseGraph(
        R, p, map.keyframes.parent[keyframes] < 0, a, b,
        np.concatenate([R_ab, map.loops.R[closed], [loop.T_a_b.R for loop in loops]]),
        np.concatenate([p_ab, map.loops.p[closed], [loop.T_a_b.t for loop in loops]]),
        edge_information(n_shared, depth_m[a], sigma_rad),
    )  # fmt: skip
    result = optimize_pose_graph(graph)
    move_points(map, keyframes, R, p, result.R, result.p)
    map.keyframes.R[keyframes], map.keyframes.p[keyframes] = result.R, result.p
    return float(np.linalg.norm(result.p - p, axis=1).max())


def present_edges(map: Map, keyframes: Ints) -> tuple[Ints, Ints, Ints]:
    """Rows (a, b) of keyframes joined by the spanning tree or by many common points, and how many those are."""
    row = {int(keyframe): i for i, keyframe in enumerate(keyframes)}
    edges = []
    for b, keyframe in enumerate(keyframes):
        shared = map.shared_counts(map.points_of(int(keyframe)))[keyframes]
        joined = set(np.flatnonzero(shared[:b] >= STRONG_SHARED).tolist())  # later ones have their own turn
        parent = int(map.keyframes.parent[keyframe])
        if parent >= 0:
            joined.add(row[parent])
        edges += [(a, b, max(int(shared[a]), 1)) for a in sorted(joined)]
    table = np.array(edges, np.int32).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def median_distance(map: Map, keyframe: int) -> float:
    """From a keyframe to its points, m."""
    point = map.points_of(keyframe)
    distance = np.linalg.norm(map.points.xyz[point[point >= 0]] - map.keyframes.p[keyframe], axis=1)
    return float(np.median(distance)) if len(distance) else 1.0


def edge_information(n_shared: Ints, depth_m: Array, sigma_rad: float) -> Array:
    """(E, 6, 6) of relative poses that hang on n points seen with sigma_rad at a distance: their mean, at best."""
    sigma = np.maximum(sigma_rad / np.sqrt(n_shared), 1e-9)
    out = np.zeros((len(n_shared), 6, 6))
    axes = np.arange(3)
    out[:, axes, axes] = sigma[:, None] ** -2
    out[:, axes + 3, axes + 3] = (sigma * depth_m)[:, None] ** -2
    return out


def move_points(map: Map, keyframes: Ints, R_old: Array, p_old: Array, R_new: Array, p_new: Array) -> None:
    """Carry every point along with the keyframe it was born in, or with one that sees it where that is gone."""
    points = map.alive_points
    reference = map.points.first_keyframe[points]
    sees = map.features.keyframe[map.points.head[points]]
    reference = np.where(map.keyframes.alive[reference], reference, sees)
    row = np.searchsorted(keyframes, reference)
    moved = np.isin(reference, keyframes)
    points, row = points[moved], row[moved]
    local = np.einsum("nji,nj->ni", R_old[row], map.points.xyz[points] - p_old[row])
    map.points.xyz[points] = np.einsum("nij,nj->ni", R_new[row], local) + p_new[row]


# -- what was double ------------------------------------------------------------------------------------------------


def fuse_doubles(map: Map, here: Ints, there: Ints, orb: OrbConfig) -> None:
    """Look for the points of keyframes `there` in the images of those `here`."""
    points = points_of_keyframes(map, there)
    for keyframe in here:
        points = np.unique(map.surviving(points))
        fuse_into(map, int(keyframe), points[points >= 0], orb, FUSE_PX)
    map.refresh_points(points_of_keyframes(map, here), orb.scale_factor, orb.n_levels)


def unite(map: Map, loop: Pair) -> None:
    """The verified matches of either direction become observations of one point."""
    for keyframe, located in ((loop.a, loop.there), (loop.b, loop.back)):
        map.join(map.feature_range(keyframe).start + located.feature, located.point)


def take_along(map: Map, R_before: Array, p_before: Array) -> None:
    """Keyframes that tracking inserted while the rest was adjusted follow their parents, and their points them."""
    n = len(R_before)
    late = np.arange(n, len(map.keyframes), dtype=np.int32)
    old = {int(k): map.pose(int(k)) for k in late}
    for k in late.tolist():
        parent = int(map.keyframes.parent[k])
        parent_old = old[parent] if parent >= n else SE3(R_before[parent], p_before[parent])
        map.set_pose(k, map.pose(parent) @ parent_old.inverse() @ old[k])
    born = np.flatnonzero(map.points.alive & (map.points.first_keyframe >= n))
    for point in born:
        k = int(map.points.first_keyframe[point])
        map.points.xyz[point] = map.pose(k) @ old[k].inverse() @ map.points.xyz[point]
