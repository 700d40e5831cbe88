"""Which format a recording is in, by its content."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lodelight.errors import SourceError
from lodelight.io import euroc, images, kitti, sevenscenes, tum_rgbd, video
from lodelight.io.calibrations import load_rig
from lodelight.io.recording import Recording
from lodelight.rig import Rig

# In this order: a bare image folder is what is left when nothing says more.
FORMATS: tuple[tuple[Callable[[Path], bool], Callable[[Path, Rig | None], Recording]], ...] = (
    (euroc.recognize, euroc.open_euroc),
    (tum_rgbd.recognize, tum_rgbd.open_tum_rgbd),
    (kitti.recognize, kitti.open_kitti),
    (sevenscenes.recognize, sevenscenes.open_sevenscenes),
    (images.recognize, images.open_images),
    (video.recognize, video.open_video),
)
KNOWN = (
    "EuRoC or TUM-VI (mav0/), TUM RGB-D (rgb.txt), KITTI odometry (calib.txt, image_0/), "
    "7-Scenes (frame-000000.color.png), a folder of images, a video file"
)


def open_source(path: str | Path, rig: Rig | str | Path | None = None) -> Recording:
    """Open a recording of any format this package knows.

    rig : overrides what the recording says of its sensors: a Rig, or a file `load_rig` reads; without it a
        `rig.toml` in the recording's folder does
    Raises SourceError where nothing recognises it, CalibrationError where its rig is missing or wrong.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f"recording {path} does not exist")
    if path.name == "mav0":  # the recording is the folder around it
        path = path.resolve().parent
    beside = (path if path.is_dir() else path.parent) / "rig.toml"
    if rig is None and beside.is_file():
        rig = beside
    opener = _opener(path)
    if opener is None:
        raise SourceError(f"{path} is no recording known here; {_hint(path)}")
    return opener(path, load_rig(rig) if isinstance(rig, str | Path) else rig)


def _opener(path: Path) -> Callable[[Path, Rig | None], Recording] | None:
    return next((read for recognize, read in FORMATS if recognize(path)), None)


def _hint(path: Path) -> str:
    """The folder inside that is one, if there is, else what is known."""
    inside = sorted(folder for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []
    found = next((folder for folder in inside if _opener(folder)), None)
    return f"{found} is: give that" if found else f"expected {KNOWN}"
