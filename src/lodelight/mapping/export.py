"""A map as other programs read it: what the writers in `lodelight.io` take, gathered from the map's tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lodelight.io.clouds import write_pcd, write_ply
from lodelight.io.colmap import Sightings, write_colmap
from lodelight.mapping.map import Map


def export_cloud(map: Map, out: Path) -> dict[str, Any]:
    """The living points with their mean viewing direction and number of observations, `.ply` or `.pcd` by name."""
    p = map.points
    alive = p.alive
    write = write_pcd if out.suffix.lower() == ".pcd" else write_ply
    write(out, p.xyz[alive], p.normal[alive], n_obs=p.n_obs[alive])
    return {"points": int(alive.sum())}


def export_colmap(map: Map, folder: Path) -> dict[str, Any]:
    """The living keyframes as images of camera 0 named by their stamps (`<t_ns>.png`), and the points they see."""
    keyframes, points = map.alive_keyframes, map.alive_points
    f, spec = map.features, map.rig.cameras[0]
    rows = np.flatnonzero(f.point >= 0)
    image = np.searchsorted(keyframes, f.keyframe[rows])
    seen = Sightings(image, np.searchsorted(points, f.point[rows]), f.px[rows].astype(np.float64))
    images = [(f"{map.keyframes.t_ns[k]}.png", map.pose(int(k)) @ spec.T_body_cam) for k in keyframes]
    write_colmap(folder, spec.camera, images, map.points.xyz[points], seen)
    return {"images": len(images), "points": len(points), "observations": len(seen)}
