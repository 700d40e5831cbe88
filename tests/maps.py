"""Simulated maps for tests: a room whose walls carry points, and a camera that walks round in it and looks at them."""

from __future__ import annotations

import numpy as np

from lodelight.features.features import Features
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.rig import CameraSpec, ImuSpec, Rig

ROOM_M = np.array([6.0, 4.0, 2.5])
EYE_M = 1.2  # the camera's height above the floor


def room_rig(model: str = "radtan", distortion: tuple[float, ...] = (-0.28, 0.07, 0.0002, 2e-5)) -> Rig:
    """One camera, ahead of the body's origin and a little tilted, and an IMU."""
    camera = Camera.create(model, 640, 480, (380.0, 381.0, 322.0, 241.0), distortion)
    looking_along_x = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_body_cam = SE3(looking_along_x, np.array([0.1, 0.02, 0.0])) @ SE3.exp(np.array([0.03, -0.02, 0.01, 0, 0, 0]))
    return Rig((CameraSpec("cam0", camera, T_body_cam, rate_hz=20.0),), imu=ImuSpec())


def room_points(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) m on the walls of a room whose floor is z = 0 and whose corner is the origin."""
    wall = rng.integers(0, 4, count)
    along = rng.uniform(0.0, 1.0, count)
    x = np.where(wall < 2, along * ROOM_M[0], np.where(wall == 2, 0.0, ROOM_M[0]))
    y = np.where(wall < 2, np.where(wall == 0, 0.0, ROOM_M[1]), along * ROOM_M[1])
    return np.column_stack([x, y, rng.uniform(0.0, ROOM_M[2], count)])


def room_map(
    seed: int = 0, n_keyframes: int = 12, n_points: int = 300, sigma_px: float = 0.0, rig: Rig | None = None
) -> Map:
    """A map whose every column is filled, true to geometry: keyframes on a round tour, each seeing what it can."""
    rng = np.random.default_rng(seed)
    map = Map(rig or room_rig())
    spec = map.rig.cameras[0]
    xyz = room_points(rng, n_points)
    desc = rng.integers(0, 2**64, (n_points, 4), dtype=np.uint64)
    known = np.full(n_points, -1, np.int32)
    for k in range(n_keyframes):
        turn = 2 * np.pi * k / n_keyframes
        p = np.array([ROOM_M[0] / 2 + 1.2 * np.cos(turn), ROOM_M[1] / 2 + 0.8 * np.sin(turn), EYE_M])
        T_world_body = SE3.exp(np.array([0.0, 0.0, turn, *p])) @ SE3.exp(np.append(rng.normal(0, 0.02, 3), [0, 0, 0]))
        X_cam = (T_world_body @ spec.T_body_cam).inverse() @ xyz
        px, inside = spec.camera.project(X_cam)
        px += rng.normal(0.0, sigma_px, px.shape) if sigma_px else 0.0
        seen = np.flatnonzero(inside & spec.camera.inside(px))
        n = len(seen)
        inv_depth = (1.0 / X_cam[seen, 2]).astype(np.float32)
        features = Features(
            px=px[seen].astype(np.float32), octave=rng.integers(0, 8, n).astype(np.int32),
            angle=rng.uniform(-np.pi, np.pi, n).astype(np.float32), desc=desc[seen],
            ray=spec.camera.unproject(px[seen])[0], inv_depth=inv_depth,
            sigma_inv_depth=(0.01 * inv_depth).astype(np.float32),
        )  # fmt: skip
        keyframe = map.add_keyframe(k * 50_000_000 + 7, T_world_body, features, weight=1.0 + 0.1 * k, parent=k - 1)
        rows = np.arange(map.feature_range(keyframe).start, map.feature_range(keyframe).stop, dtype=np.int32)
        new = known[seen] < 0
        known[seen[new]] = map.add_points(xyz[seen[new]], rows[new], keyframe)
        map.link(rows[~new], known[seen[~new]])
    if n_keyframes > 3:
        T_a_b = map.pose(0).inverse() @ map.pose(n_keyframes - 1)
        map.loops.append(1, a=0, b=n_keyframes - 1, R=T_a_b.R, p=T_a_b.t)
    if len(map.points):
        map.refresh_points(map.alive_points, 1.2, 8)
    return map


def thinned(map: Map, seed: int = 0) -> Map:
    """The same map after what mapping does to one: keyframes and points culled, points fused."""
    rng = np.random.default_rng(seed)
    alive = map.alive_points
    map.remove_points(rng.choice(alive, len(alive) // 5, replace=False))
    for old, new in rng.choice(map.alive_points, (len(alive) // 20, 2), replace=False):
        map.fuse_points(int(old), int(new))
    for keyframe in rng.choice(np.arange(1, len(map.keyframes) - 1), len(map.keyframes) // 4, replace=False):
        map.remove_keyframe(int(keyframe))
    return map


def large_map(n_keyframes: int = 2000, n_features: int = 1000, n_points: int = 100_000, seed: int = 0) -> Map:
    """A map of a given size without geometry: half of all features see a random point."""
    rng = np.random.default_rng(seed)
    map = Map(room_rig())
    for k in range(n_keyframes):
        px = rng.uniform(0.0, [639.0, 479.0], (n_features, 2)).astype(np.float32)
        n = n_features
        features = Features(
            px=px, octave=rng.integers(0, 8, n).astype(np.int32), angle=rng.random(n, np.float32),
            desc=rng.integers(0, 2**64, (n, 4), dtype=np.uint64), ray=np.zeros((n, 3)),
            inv_depth=rng.random(n, np.float32), sigma_inv_depth=rng.random(n, np.float32),
        )  # fmt: skip
        map.add_keyframe(k * 50_000_000, SE3.exp(rng.normal(size=6)), features, parent=k - 1)
    rows = rng.permutation(len(map.features)).astype(np.int32)
    for first in range(0, n_points, 50):
        keyframe = rng.integers(n_keyframes)
        map.add_points(rng.normal(size=(50, 3)) * 10.0, rows[first : first + 50], int(keyframe))
    point = np.append(np.arange(n_points), rng.integers(0, n_points, len(rows) // 2 - n_points)).astype(np.int32)
    seen_by = map.features.keyframe[rows[: len(point)]].astype(np.int64)
    _, once = np.unique(point * n_keyframes + seen_by, return_index=True)  # a keyframe sees a point once
    more = once[once >= n_points]
    map.link(rows[more], point[more])
    return map
