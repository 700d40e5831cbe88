"""A map as other programs read it: what the writers in `lodelight.io` take, gathered from the map's tables."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.io.clouds import write_pcd, write_ply
from lodelight.io.colmap import Sightings, write_colmap
from lodelight.io.occupancy import FREE, OCCUPIED, write_occupancy
from lodelight.mapping.grid import occupancy_grid
from lodelight.mapping.map import Map
from lodelight.mapping.upright import estimate_up
from lodelight.types import Array

LEVEL_DEG = 5.0  # what an estimate of up from a surface errs: nearer to the map's own z, z it is
PITCH_DEG = 45.0  # what the mean of the cameras' own up may be off, all of them looking down at a table


def export_cloud(map: Map, out: Path, format: str) -> dict[str, Any]:
    """The living points with their mean viewing direction and number of observations; format ply or pcd."""
    p = map.points
    write = {"ply": write_ply, "pcd": write_pcd}[format]
    write(out, p.xyz[p.alive], p.normal[p.alive], n_obs=p.n_obs[p.alive])
    return {"points": int(p.alive.sum())}


def export_colmap(map: Map, folder: Path) -> dict[str, Any]:
    """The living keyframes as images of camera 0 named by their stamps (`<t_ns>.png`), and the points they see.

    In a map of several recordings two may have one stamp: the second is `<t_ns>_2.png`.
    """
    keyframes, points = map.alive_keyframes, map.alive_points
    f, spec = map.features, map.rig.cameras[0]
    rows = np.flatnonzero(f.point >= 0)
    image = np.searchsorted(keyframes, f.keyframe[rows])
    seen = Sightings(image, np.searchsorted(points, f.point[rows]), f.px[rows].astype(np.float64))
    times: Counter[int] = Counter()
    images = []
    for k in keyframes.tolist():
        t_ns = int(map.keyframes.t_ns[k])
        times[t_ns] += 1
        again = f"_{times[t_ns]}" if times[t_ns] > 1 else ""
        images.append((f"{t_ns}{again}.png", map.pose(k) @ spec.T_body_cam))
    write_colmap(folder, spec.camera, images, map.points.xyz[points], seen)
    return {"images": len(images), "points": len(points), "observations": len(seen)}


def export_grid(map: Map, out: Path, up: Array | None = None, **options: Any) -> dict[str, Any]:
    """The occupancy grid of all sightings, PGM and YAML, with its frame told in comments.

    up : unit (3,) in the map's frame, estimated where it is None; options as of `occupancy_grid`
    """
    how = "as given"
    if up is None:
        up, how = map_up(map)
    k, f = map.keyframes, map.features
    rows = np.flatnonzero(f.point >= 0)
    centres = k.p + k.R @ map.rig.cameras[0].T_body_cam.t
    grid = occupancy_grid(centres[f.keyframe[rows]], map.points.xyz[f.point[rows]], up, **options)
    told = {
        "up": f"{' '.join(f'{v + 0.0:.4f}' for v in up)} in the map's frame, {how}",
        "floor_m": round(grid.floor_m, 3),
        "quat_xyzw_grid_map": np.round(SE3(grid.R_grid_map, np.zeros(3)).quat_xyzw + 0.0, 9).tolist(),
        "cells": list(grid.cells.shape[::-1]),
        "occupied": int((grid.cells == OCCUPIED).sum()),
        "free": int((grid.cells == FREE).sum()),
    }
    remarks = "\n".join(f"{key}: {told[key]}" for key in ("up", "floor_m", "quat_xyzw_grid_map"))
    write_occupancy(out, grid.cells, grid.resolution_m, grid.origin_xy_m, remarks)
    return told


def map_up(map: Map) -> tuple[Array, str]:
    """Unit vector up (3,) in the map's frame, and how it is known: the map's z wherever the cameras do not belie it."""
    z = np.array([0.0, 0.0, 1.0])
    spec = map.rig.cameras[0]
    poses = [map.pose(int(k)) @ spec.T_body_cam for k in map.alive_keyframes]
    if not poses:
        return z, "its z, for want of keyframes"
    R_world_cam, centres = np.array([T.R for T in poses]), np.array([T.t for T in poses])
    up, share = estimate_up(map.points.xyz[map.points.alive], R_world_cam, centres)
    off_deg = float(np.degrees(np.arccos(np.clip(up @ z, -1.0, 1.0))))
    if share > 0.0 and off_deg > LEVEL_DEG:
        return up, f"the normal of the largest surface seen from above, which holds {100 * share:.0f} % of the points"
    if share > 0.0:
        return z, f"its z, {off_deg:.1f} degrees from the normal of the largest surface seen from above"
    if off_deg > PITCH_DEG:
        return up, "the cameras' own on the average, for want of a floor or a table; better give it"
    return z, f"its z, {off_deg:.0f} degrees from the cameras' own on the average, for want of a floor or a table"
