"""KITTI odometry sequences: `image_0`, `image_1`, `calib.txt`, `times.txt`; rectified, no IMU.

Source: Geiger, Lenz, Urtasun 2012. The body is the left grey camera, whose poses the truth holds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lodelight.errors import CalibrationError, SourceError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.listing import ListedRecording, Listing
from lodelight.io.pictures import BadFrame, read_grey
from lodelight.io.stamps import ns_from_seconds
from lodelight.io.text import fields, lines
from lodelight.io.trajectories import read_trajectory
from lodelight.rig import CameraSpec, Rig
from lodelight.trajectory import Trajectory
from lodelight.types import Array

FORMAT = "kitti"


def recognize(path: Path) -> bool:
    return (path / "calib.txt").is_file() and any((path / f"image_{i}").is_dir() for i in (0, 2))


def open_kitti(path: Path, rig: Rig | None) -> ListedRecording:
    """The grey pair where there is one, else the colour pair; row i of `times.txt` is the stamp of image i."""
    left = 0 if (path / "image_0").is_dir() else 2
    numbers = [i for i in (left, left + 1) if (path / f"image_{i}").is_dir()]
    try:
        t_ns = np.array([ns_from_seconds(line) for _, line in lines(path / "times.txt")], dtype=np.int64)
    except ValueError as error:
        raise SourceError(f"{path / 'times.txt'}: {error}") from None
    suffix = next((file.suffix for file in sorted((path / f"image_{left}").iterdir())), ".png")
    images: list[list[Path | None]] = [
        [path / f"image_{n}" / f"{i:06d}{suffix}" for i in range(len(t_ns))] for n in numbers
    ]
    rig = rig or _built_in_rig(path, numbers)
    return ListedRecording(path, FORMAT, rig, Listing(t_ns, tuple(images)), truth=lambda: _truth(path))


def _built_in_rig(path: Path, numbers: list[int]) -> Rig:
    """Each projection P (3, 4) is K [I | t]: the camera sits at -t of the left grey one."""
    projections = _read_calib(path / "calib.txt")
    cameras = []
    for n in numbers:
        P = projections.get(f"P{n}")
        if P is None:
            raise CalibrationError(f"{path / 'calib.txt'}: P{n} is missing; add its twelve numbers")
        width, height = _image_size(path / f"image_{n}")
        camera = Camera.create("radtan", width, height, (P[0, 0], P[1, 1], P[0, 2], P[1, 2]))
        position = -np.linalg.solve(P[:, :3], P[:, 3]).astype(np.float64)
        cameras.append(CameraSpec(f"cam{n}", camera, SE3(np.eye(3), position)))
    return Rig(tuple(cameras))


def _read_calib(file: Path) -> dict[str, Array]:
    out: dict[str, Array] = {}
    for number, line in lines(file):
        name, _, rest = line.partition(":")
        try:
            matrix = np.array([float(v) for v in fields(rest)])
        except ValueError:
            matrix = np.empty(0)
        if name.startswith("P"):
            if len(matrix) != 12 or not np.isfinite(matrix).all():
                raise CalibrationError(f"{file} line {number}: {name} must be twelve finite numbers")
            out[name] = matrix.reshape(3, 4)
    return out


def _image_size(folder: Path) -> tuple[int, int]:
    for file in sorted(folder.iterdir()):
        try:
            height, width = read_grey(file).shape
        except BadFrame:
            continue
        return width, height
    raise SourceError(f"{folder} has no readable image")


def _truth(path: Path) -> Trajectory | None:
    """From `poses.txt` of the sequence, or `poses/<sequence>.txt` one or two folders up, as the benchmark has it."""
    name = f"{path.resolve().name}.txt"
    above = path.resolve().parent
    for file in (path / "poses.txt", above / "poses" / name, above.parent / "poses" / name):
        if file.is_file():
            return read_trajectory(file, times=path / "times.txt")
    return None
