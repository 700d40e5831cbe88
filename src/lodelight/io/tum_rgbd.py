"""TUM RGB-D recordings: `rgb.txt`, `depth.txt`, `groundtruth.txt`. Depth comes registered to colour.

Source: Sturm et al. 2012, https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import re
from pathlib import Path

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.listing import ListedRecording, Listing, bad_rows
from lodelight.io.stamps import associate, ns_from_seconds
from lodelight.io.text import read_files, read_text
from lodelight.io.trajectories import read_trajectory
from lodelight.rig import KINECT_ROW_TIME_S, CameraSpec, DepthSpec, Rig
from lodelight.trajectory import Trajectory

FORMAT = "tum_rgbd"
UNITS_PER_M = 5000.0
# Colour and depth are exposed apart by up to half a period of 30 Hz; 20 ms is also the benchmark's own tolerance.
TOLERANCE_NS = 20_000_000

# The colour cameras as published with the benchmark: fx fy cx cy, k1 k2 p1 p2 k3.
LENSES: dict[str, tuple[tuple[float, float, float, float], tuple[float, ...]]] = {
    "1": (
        (517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "2": (
        (520.908620, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}


def recognize(path: Path) -> bool:
    return (path / "rgb.txt").is_file()


def open_tum_rgbd(path: Path, rig: Rig | None) -> ListedRecording:
    """Colour and depth are paired by stamp within 20 ms, the closest pairs first, each depth image used once."""
    t_rgb, rgb, bad = read_files(path / "rgb.txt", ns_from_seconds)
    unread = bad_rows(path / "rgb.txt", bad)
    depth: list[Path | None] | None = None
    if (path / "depth.txt").is_file():
        t_depth, files, bad = read_files(path / "depth.txt", ns_from_seconds)
        unread += bad_rows(path / "depth.txt", bad)
        partner = associate(t_rgb, t_depth, TOLERANCE_NS)
        depth = [path / files[j] if j >= 0 else None for j in partner.tolist()]
    listing = Listing(t_rgb, ([path / name for name in rgb],), depth, unread)
    return ListedRecording(path, FORMAT, rig or _built_in_rig(path), listing, truth=lambda: _truth(path))


def _built_in_rig(path: Path) -> Rig:
    text = path.resolve().name + "".join(read_text(path / name)[:500] for name in _comment_files(path))
    found = re.search(r"(?<![a-z])(?:freiburg|fr)_?([123])(?!\d)", text)
    if not found:
        raise CalibrationError(
            f"{path} does not say which freiburg camera took it; put a rig.toml there or give --rig FILE"
        )
    camera = Camera.create("radtan", 640, 480, *LENSES[found[1]])
    row_time_s = 0.0 if found[1] == "3" else KINECT_ROW_TIME_S  # the third was an Asus Xtion
    depth = DepthSpec(camera, SE3.identity(), units_per_m=UNITS_PER_M)
    # The driver, ROS's openni_camera, stamps an image when it has arrived, which is after its last row was read.
    colour = CameraSpec("cam0", camera, SE3.identity(), row_time_s=row_time_s, stamped_row=float(camera.height))
    return Rig((colour,), depth=depth)


def _comment_files(path: Path) -> list[str]:
    """The lists whose first comment names the bag the recording was cut from."""
    return [n for n in ("rgb.txt", "depth.txt", "groundtruth.txt", "accelerometer.txt") if (path / n).is_file()]


def _truth(path: Path) -> Trajectory | None:
    file = path / "groundtruth.txt"
    return read_trajectory(file) if file.is_file() else None
