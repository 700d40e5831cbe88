"""Which format a recording is in, by its content."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from lodelight.errors import ConfigError, SourceError
from lodelight.io import camera, euroc, images, kitti, rosbag_recording, sevenscenes, tum_rgbd, video
from lodelight.io.calibrations import load_rig
from lodelight.io.recording import Recording
from lodelight.rig import Rig

# In this order: a bare image folder is what is left when nothing says more.
FORMATS: tuple[tuple[Callable[[Path], bool], Callable[[Path, Rig | None], Recording]], ...] = (
    (camera.recognize, camera.open_camera),
    (euroc.recognize, euroc.open_euroc),
    (tum_rgbd.recognize, tum_rgbd.open_tum_rgbd),
    (kitti.recognize, kitti.open_kitti),
    (sevenscenes.recognize, sevenscenes.open_sevenscenes),
    (rosbag_recording.recognize, rosbag_recording.open_rosbag),
    (images.recognize, images.open_images),
    (video.recognize, video.open_video),
    (images.recognize_one, images.open_one),
)
KNOWN = (
    "EuRoC or TUM-VI (mav0/), TUM RGB-D (rgb.txt), KITTI odometry (calib.txt, image_0/), "
    "7-Scenes (frame-000000.color.png), a ROS bag (ROS 1, sqlite3, MCAP), a folder of images, "
    "an image, a video file, or the number of a camera"
)


def open_source(
    path: str | Path, rig: Rig | str | Path | None = None, topics: Mapping[str, str] | None = None
) -> Recording:
    """Open a recording of any format this package knows.

    rig : overrides what the recording says of its sensors: a Rig, or a file `load_rig` reads; without it a
        `rig.toml` in the recording's folder does, unless it is a bag that carries its rig
    topics : of a ROS bag, by role (cam0, cam1, ..., depth, imu, lights, truth); what is not named is found by type
    Raises SourceError where nothing recognises it, CalibrationError where its rig is missing or wrong.
    """
    path = Path(path)
    if not path.exists() and not camera.recognize(path):
        raise SourceError(f"recording {path} does not exist")
    if path.name == "mav0":  # the recording is the folder around it
        path = path.resolve().parent
    opener = _opener(path)
    is_bag = opener is rosbag_recording.open_rosbag
    beside = (path if path.is_dir() else path.parent) / "rig.toml"
    if rig is None and beside.is_file() and not (is_bag and rosbag_recording.carries_rig(path)):
        rig = beside
    if is_bag:
        opener = partial(rosbag_recording.open_rosbag, roles=topics)
    elif topics:
        raise ConfigError(f"{path} is no ROS bag and has no topics; leave out --topic")
    if opener is None:
        raise SourceError(f"{path} is no recording known here; {_hint(path)}")
    return opener(path, load_rig(rig) if isinstance(rig, str | Path) else rig)


def is_recording(path: Path) -> bool:
    """Whether its content is that of a recording."""
    return _opener(path) is not None


def _opener(path: Path) -> Callable[[Path, Rig | None], Recording] | None:
    return next((read for recognize, read in FORMATS if recognize(path)), None)


def _hint(path: Path) -> str:
    """The folder inside that is one, if there is, else what is known."""
    inside = sorted(folder for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []
    found = next((folder for folder in inside if _opener(folder)), None)
    return f"{found} is: give that" if found else f"expected {KNOWN}"
