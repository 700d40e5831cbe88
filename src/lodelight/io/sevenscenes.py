"""7-Scenes style folders: `frame-000000.color.png`, `.depth.png`, `.pose.txt`, as KinectFusion recorded them.

Frames have numbers instead of stamps: frame i is at i/30 s. Colour and depth are two cameras, not registered; the
poses are those of the depth camera. Source: Shotton et al. 2013.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lodelight.errors import CalibrationError, SourceError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.listing import ListedRecording, Listing
from lodelight.io.schema import rigid_motion
from lodelight.io.stamps import NS_PER_S
from lodelight.io.text import fields, lines
from lodelight.rig import KINECT_ROW_TIME_S, CameraSpec, DepthSpec, Rig
from lodelight.trajectory import Trajectory
from lodelight.types import Array

FORMAT = "7scenes"
RATE_HZ = 30
COLOR = re.compile(r"frame-(\d+)\.color\.(png|jpg|jpeg)")

# A Kinect v1 by its nominal values: both lenses as its drivers state them, colour 2.5 cm to the right of depth.
COLOR_LENS = (525.0, 525.0, 319.5, 239.5)
DEPTH_LENS = (585.0, 585.0, 320.0, 240.0)
T_COLOR_DEPTH = SE3(np.eye(3), np.array([-0.025, 0.0, 0.0]))


def recognize(path: Path) -> bool:
    return path.is_dir() and any(COLOR.fullmatch(file.name) for file in path.iterdir())


def open_sevenscenes(path: Path, rig: Rig | None) -> ListedRecording:
    """Colour, depth and pose belong together by the frame's number."""
    found = sorted((int(m[1]), file) for file in path.iterdir() if (m := COLOR.fullmatch(file.name)))
    numbers = [number for number, _ in found]
    stems = [file.name.split(".")[0] for _, file in found]
    depth: list[Path | None] = [file if (file := path / f"{stem}.depth.png").exists() else None for stem in stems]
    t_ns = np.array([round(number * NS_PER_S / RATE_HZ) for number in numbers], dtype=np.int64)
    rig = rig or _built_in_rig(path)
    listing = Listing(t_ns, ([file for _, file in found],), depth if any(depth) else None)
    T_depth_body = (rig.depth.T_body_depth if rig.depth else T_COLOR_DEPTH).inverse()

    def truth() -> Trajectory | None:
        stamped = [(t, path / f"{stem}.pose.txt") for t, stem in zip(t_ns.tolist(), stems, strict=True)]
        poses = [(t, _read_matrix(file)) for t, file in stamped if file.is_file()]
        known = [(t, T) for t, T in poses if np.isfinite(T).all()]  # a frame the tracker lost has no numbers
        T_world_body = [rigid_motion(T, f"{path} pose") @ T_depth_body for _, T in known]
        return Trajectory.from_poses([t for t, _ in known], T_world_body) if known else None

    return ListedRecording(path, FORMAT, rig, listing, truth=truth)


def _built_in_rig(path: Path) -> Rig:
    lens = Camera.create("radtan", 640, 480, COLOR_LENS)
    color = CameraSpec("cam0", lens, SE3.identity(), rate_hz=float(RATE_HZ), row_time_s=KINECT_ROW_TIME_S)
    depth = DepthSpec(_depth_lens(path), T_COLOR_DEPTH, units_per_m=1000.0, registered=False)
    return Rig((color,), depth=depth)


def _depth_lens(path: Path) -> Camera:
    """From `camera-intrinsics.txt`, a 3x3 pinhole matrix, where the folder has one."""
    file = path / "camera-intrinsics.txt"
    if not file.is_file():
        return Camera.create("radtan", 640, 480, DEPTH_LENS)
    K = _read_matrix(file)
    if K.shape != (3, 3):
        raise CalibrationError(f"{file} must hold a 3x3 pinhole matrix")
    return Camera.create("radtan", 640, 480, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


def _read_matrix(file: Path) -> Array:
    try:
        return np.array([[float(v) for v in fields(line)] for _, line in lines(file)])
    except ValueError:
        raise SourceError(f"{file} is no matrix of numbers") from None
