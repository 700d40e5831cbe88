"""The part of the map that a camera near a pose should see, and where it should see it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lodelight.compiled import kernel
from lodelight.features.orb import OrbConfig
from lodelight.geometry.cameras import Camera, project_point
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.types import AnyArray, Array, Bools, Ints

MAX_KEYFRAMES = 80
NEIGHBOURS_OF = 10  # so many of the best voters bring their best neighbours along
MIN_VIEW_COSINE = 0.5  # a patch seen 60 degrees from where it was mapped looks like another
RANGE_SLACK = 1.2  # of a point's scale range, as octaves are coarse


@dataclass(frozen=True, eq=False)
class Sight:
    """Points expected in the image.

    point : (M,) ids; px : (M, 2) predicted; octave : (M,) predicted pyramid level; cosine : (M,) between the present
    and the mean mapped viewing direction
    """

    point: Ints
    px: Array
    octave: Ints
    cosine: Array


def local_keyframes(map: Map, points: Ints, otherwise: int) -> Ints:
    """Keyframes that see the given points (-1 = none), most first, then their best neighbours and their parents.

    otherwise : the keyframe to begin with where no point is given
    """
    votes = map.shared_counts(points)
    voters = np.flatnonzero(votes)
    voters = voters[np.argsort(-votes[voters], kind="stable")][:MAX_KEYFRAMES]
    if len(voters) == 0:
        voters = np.array([otherwise])
    chosen = dict.fromkeys(int(k) for k in voters)
    for k in voters[:NEIGHBOURS_OF]:
        if len(chosen) >= MAX_KEYFRAMES:
            break
        neighbours, _ = map.covisible(int(k), min_shared=15)
        for other in [*neighbours[:2].tolist(), int(map.keyframes.parent[k])]:
            if other >= 0:
                chosen.setdefault(int(other))
    return np.array(list(chosen)[:MAX_KEYFRAMES], np.int32)


def keyframes_near(map: Map, T_world_cam: SE3, reach_m: AnyArray | float, turn_deg: float) -> Ints:
    """Keyframes within reach of a camera (of each keyframe, where there are several), that look where it looks: the
    nearest first."""
    k, T_body_cam = map.keyframes, map.rig.cameras[0].T_body_cam
    distance = np.linalg.norm(k.p + k.R @ T_body_cam.t - T_world_cam.t, axis=1)
    cosine = k.R @ T_body_cam.R[:, 2] @ T_world_cam.R[:, 2]
    near = k.alive & (distance <= reach_m) & (cosine >= math.cos(math.radians(min(turn_deg, 180.0))) - 1e-9)
    found = np.flatnonzero(near).astype(np.int32)
    return found[np.argsort(distance[found], kind="stable")]


def points_of_keyframes(map: Map, keyframes: Ints) -> Ints:
    """Alive points that any of the keyframes sees, each once, by rising id."""
    if len(keyframes) == 0:
        return np.zeros(0, np.int32)
    rows = np.concatenate([map.points_of(int(k)) for k in keyframes])
    seen = np.zeros(len(map.points), np.bool_)  # marking is ten times as fast as sorting, and done every frame
    seen[rows[rows >= 0]] = True
    return np.flatnonzero(seen & map.points.alive).astype(np.int32)


def in_sight(
    map: Map, points: Ints, T_world_body: SE3, T_body_cam: SE3, camera: Camera, orb: OrbConfig, any_view: bool = False
) -> Sight:
    """Which of the points (ids) a camera at T_world_body should see, where, and at which octave.

    any_view : also from directions and distances at which the patch may look different
    """
    mapped_px = map.rig.cameras[0].camera.focal_px
    return in_sight_of(map.points, points, mapped_px, T_world_body, T_body_cam, camera, orb, any_view)


def in_sight_of(
    p: Any,
    points: Ints,
    mapped_focal_px: float,
    T_world_body: SE3,
    T_body_cam: SE3,
    camera: Camera,
    orb: OrbConfig,
    any_view: bool = False,
) -> Sight:
    """As `in_sight`, of rows of a table p with xyz, normal, d_min and d_max as `Map.points` has them.

    mapped_focal_px : of the lens that d_min and d_max are for

    A longer lens shows a patch larger, so it is found at a coarser octave, and from farther away.
    """
    T_cam_world = (T_world_body @ T_body_cam).inverse()
    px, octave, cosine, seen = _project_points(
        points, p.xyz, p.normal, p.d_min, p.d_max, T_cam_world.R, T_cam_world.t,
        camera.model, camera.params, camera.width, camera.height, orb.scale_factor, orb.n_levels, any_view,
        camera.focal_px / mapped_focal_px,
    )  # fmt: skip
    return Sight(points[seen], px[seen], octave[seen], cosine[seen])


@kernel
def _project_points(
    points: Ints, xyz: Array, normal: Array, d_min: Array, d_max: Array, R_cam_world: Array, p_cam_world: Array,
    model: int, params: Array, width: int, height: int, scale_factor: float, n_levels: int, any_view: bool,
    magnification: float,
) -> tuple[Array, Ints, Array, Bools]:  # fmt: skip
    n = len(points)
    px = np.zeros((n, 2))
    octave = np.zeros(n, np.int32)
    cosine = np.zeros(n)
    seen = np.zeros(n, np.bool_)
    centre = -R_cam_world.T @ p_cam_world
    log_scale = math.log(scale_factor)
    for i in range(n):
        m = points[i]
        x, y, z = xyz[m, 0], xyz[m, 1], xyz[m, 2]
        u, v, ok = project_point(
            model,
            params,
            R_cam_world[0, 0] * x + R_cam_world[0, 1] * y + R_cam_world[0, 2] * z + p_cam_world[0],
            R_cam_world[1, 0] * x + R_cam_world[1, 1] * y + R_cam_world[1, 2] * z + p_cam_world[1],
            R_cam_world[2, 0] * x + R_cam_world[2, 1] * y + R_cam_world[2, 2] * z + p_cam_world[2],
        )
        if not ok or u < 0.0 or v < 0.0 or u > width - 1 or v > height - 1:
            continue
        dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
        d = math.sqrt(dx * dx + dy * dy + dz * dz)
        cosine[i] = (dx * normal[m, 0] + dy * normal[m, 1] + dz * normal[m, 2]) / max(d, 1e-9)
        d /= magnification  # from where the mapping lens would show the patch as large
        if not any_view and (d < d_min[m] / RANGE_SLACK or d > d_max[m] * RANGE_SLACK or cosine[i] < MIN_VIEW_COSINE):
            continue
        level = math.ceil(math.log(max(d_max[m] / max(d, 1e-9), 1e-9)) / log_scale - 0.5)
        octave[i] = min(max(level, 0), n_levels - 1)
        px[i, 0], px[i, 1] = u, v
        seen[i] = True
    return px, octave, cosine, seen
