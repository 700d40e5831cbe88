"""Which format a recording is in, by its content."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lodelight.errors import SourceError
from lodelight.io import euroc, sevenscenes, tum_rgbd
from lodelight.io.calibrations import load_rig
from lodelight.io.recording import Recording
from lodelight.rig import Rig

FORMATS: tuple[tuple[Callable[[Path], bool], Callable[[Path, Rig | None], Recording]], ...] = (
    (euroc.recognize, euroc.open_euroc),
    (tum_rgbd.recognize, tum_rgbd.open_tum_rgbd),
    (sevenscenes.recognize, sevenscenes.open_sevenscenes),
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
    if rig is None and (path / "rig.toml").is_file():
        rig = path / "rig.toml"
    known = load_rig(rig) if isinstance(rig, str | Path) else rig
    for recognize, read in FORMATS:
        if recognize(path):
            return read(path, known)
    raise SourceError(f"{path} is no recording known here")
