"""COLMAP's text model: cameras.txt, images.txt, points3D.txt, as dense reconstruction and splatting tools take it.

COLMAP's image plane starts at the corner of the top-left pixel, ours at its centre: half a pixel is added.
Source: https://colmap.github.io/format.html and cameras.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import EQUIDISTANT, RADTAN, Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.text import write_text
from lodelight.types import AnyArray, Array

CORNER_PX = 0.5


@dataclass(frozen=True, eq=False)
class Sightings:
    """Which image sees which point where: parallel arrays, rows of `images` and of `points`, and px (N, 2)."""

    image: AnyArray
    point: AnyArray
    px: AnyArray

    def __len__(self) -> int:
        return len(self.image)


Image: TypeAlias = tuple[str, SE3]


def write_colmap(folder: str | Path, camera: Camera, images: list[Image], xyz: Array, seen: Sightings) -> None:
    """One camera, its images (file name, T_world_cam), points (N, 3) m, and who sees what. Ids are rows plus one.

    Points have no colour (grey) and the mean reprojection error of their sightings; a point nobody sees is left out.
    Raises CalibrationError for a lens that COLMAP does not have.
    """
    order = np.argsort(seen.image, kind="stable")  # by image, and in each image in the order they came
    seen = Sightings(seen.image[order], seen.point[order], seen.px[order])
    starts = np.searchsorted(seen.image, np.arange(len(images) + 1))
    line = camera_line(camera)
    folder = Path(folder)
    write_text(folder / "cameras.txt", f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 {line}\n")
    write_text(folder / "images.txt", _images(images, seen, starts))
    write_text(folder / "points3D.txt", _points(camera, images, xyz, seen, starts))


def camera_line(camera: Camera) -> str:
    """`MODEL WIDTH HEIGHT PARAMS[]`: PINHOLE, OPENCV, FULL_OPENCV or OPENCV_FISHEYE, whichever is exact."""
    fx, fy, cx, cy = (float(v) for v in camera.params[:4])
    k = camera.distortion
    if camera.model == EQUIDISTANT:
        model, distortion = "OPENCV_FISHEYE", k
    elif camera.model != RADTAN:
        raise CalibrationError(
            f"COLMAP has no {camera.model_name} lens; export ply, pcd or grid, or calibrate as radtan or equidistant"
        )
    elif not any(k):
        model, distortion = "PINHOLE", ()
    elif k[4] == 0.0:
        model, distortion = "OPENCV", k[:4]
    else:
        model, distortion = "FULL_OPENCV", (*k, 0.0, 0.0, 0.0)
    params = (fx, fy, cx + CORNER_PX, cy + CORNER_PX, *distortion)
    return f"{model} {camera.width} {camera.height} {' '.join(repr(v) for v in params)}"


def _images(images: list[Image], seen: Sightings, starts: AnyArray) -> str:
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME (cam from world)\n# X Y POINT3D_ID ...\n"]
    for i, (name, T_world_cam) in enumerate(images):
        T_cam_world = T_world_cam.inverse()
        x, y, z, w = T_cam_world.quat_xyzw
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *T_cam_world.t))
        rows = slice(starts[i], starts[i + 1])
        corners = zip((seen.px[rows] + CORNER_PX).tolist(), (seen.point[rows] + 1).tolist(), strict=True)
        lines.append(f"{i + 1} {pose} 1 {name}\n" + " ".join(f"{u:.3f} {v:.3f} {m}" for (u, v), m in corners) + "\n")
    return "".join(lines)


def _points(camera: Camera, images: list[Image], xyz: Array, seen: Sightings, starts: AnyArray) -> str:
    error_px = np.zeros(len(seen))
    for i, (_, T_world_cam) in enumerate(images):
        rows = slice(starts[i], starts[i + 1])
        px, _ = camera.project(T_world_cam.inverse() @ xyz[seen.point[rows]])
        error_px[rows] = np.linalg.norm(px - seen.px[rows], axis=1)
    count = np.maximum(np.bincount(seen.point, minlength=len(xyz)), 1)
    mean_px = np.bincount(seen.point, error_px, len(xyz)) / count

    tracks: list[list[str]] = [[] for _ in range(len(xyz))]
    place = np.arange(len(seen)) - starts[seen.image]
    for image, point, index in zip((seen.image + 1).tolist(), seen.point.tolist(), place.tolist(), strict=True):
        tracks[point].append(f"{image} {index}")
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"]
    for m, ((x, y, z), error, track) in enumerate(zip(xyz.tolist(), mean_px.tolist(), tracks, strict=True)):
        if track:
            lines.append(f"{m + 1} {x:.6f} {y:.6f} {z:.6f} 128 128 128 {error:.4f} {' '.join(track)}\n")
    return "".join(lines)
