"""A folder of images of one camera; what the camera is, the rig file says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import CalibrationError, SourceError
from lodelight.io.listing import ListedRecording, Listing
from lodelight.io.pictures import SUFFIXES
from lodelight.io.stamps import NS_PER_S, ns_from_seconds, ns_from_text
from lodelight.io.text import fields, lines
from lodelight.rig import Rig

TIMES = ("timestamps.txt", "times.txt")
LAST_NUMBER = re.compile(r"\d+(\.\d+)?(?=\D*$)")
# Counters count by ones; stamps of frames in nanoseconds are far more than this apart.
LEAST_STAMP_GAP = 100_000


def recognize(path: Path) -> bool:
    return path.is_dir() and any(file.suffix.lower() in SUFFIXES for file in path.iterdir())


def open_images(path: Path, rig: Rig | None) -> ListedRecording:
    """Images in the order of the last number in their names.

    Their stamps come from `timestamps.txt` or `times.txt` (a stamp per image in order, or `name stamp` or
    `stamp name`), else from the names (seconds with a decimal point, or nanoseconds), else from counting at the
    rig's rate; a stamp without a decimal point is in nanoseconds.
    """
    if rig is None:
        raise CalibrationError(
            f"{path} says nothing of its camera; give --rig FILE or put a rig.toml beside the images"
        )
    files = sorted((file for file in path.iterdir() if file.suffix.lower() in SUFFIXES), key=_order)
    times = next((path / name for name in TIMES if (path / name).is_file()), None)
    t_ns = _listed_stamps(times, files) if times else _named_stamps(files, rig, path)
    return ListedRecording(path, "images", rig, Listing(t_ns, (list(files),)))


def recognize_one(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES


def open_one(path: Path, rig: Rig | None) -> ListedRecording:
    """A single image, taken at 0."""
    if rig is None:
        raise CalibrationError(f"{path} says nothing of its camera; give --rig FILE or put a rig.toml beside it")
    return ListedRecording(path, "image", rig, Listing(np.zeros(1, np.int64), ([path],)))


def _order(file: Path) -> tuple[float, str]:
    found = LAST_NUMBER.search(file.stem)
    return (float(found[0]) if found else -1.0, file.name)


def _named_stamps(files: list[Path], rig: Rig, path: Path) -> NDArray[np.int64]:
    found = [LAST_NUMBER.search(file.stem) for file in files]
    texts = [match[0] if match else "" for match in found]
    stamps = [_stamp(str(file), text or str(i)) for i, (file, text) in enumerate(zip(files, texts, strict=True))]
    numbers = np.array(stamps, dtype=np.int64)
    if all("." in text for text in texts):
        return numbers
    if len(numbers) > 1 and np.median(np.abs(np.diff(numbers))) >= LEAST_STAMP_GAP:
        return numbers
    rate_hz = rig.cameras[0].rate_hz
    if rate_hz <= 0:
        raise CalibrationError(
            f"the names in {path} are no stamps and the rig has no rate; add timestamps.txt, or camera[0].rate_hz"
        )
    return np.array([round(n * NS_PER_S / rate_hz) for n in numbers.tolist()], dtype=np.int64)


def _listed_stamps(file: Path, files: list[Path]) -> NDArray[np.int64]:
    rows = [(number, fields(line)) for number, line in lines(file)]
    if all(len(row) == 1 for _, row in rows):
        if len(rows) != len(files):
            raise SourceError(f"{file} has {len(rows)} stamps for {len(files)} images; they must pair up")
        return np.array([_stamp(f"{file} line {number}", row[0]) for number, row in rows], dtype=np.int64)
    if short := [number for number, row in rows if len(row) < 2]:
        raise SourceError(f"{file} line {short[0]}: expected an image and its stamp")
    stems = {name: i for i, image in enumerate(files) for name in (image.name, image.stem)}
    stamps: dict[int, int] = {}
    for number, row in rows:
        name, text = (row[0], row[1]) if row[0] in stems else (row[-1], row[0])
        if Path(name).name in stems:
            stamps[stems[Path(name).name]] = _stamp(f"{file} line {number}", text)
    missing = [image.name for i, image in enumerate(files) if i not in stamps]
    if missing:
        raise SourceError(f"{file} has no stamp for {missing[0]}; write `name stamp` for each image")
    return np.array([stamps[i] for i in range(len(files))], dtype=np.int64)


def _stamp(where: str, text: str) -> int:
    """Seconds where there is a decimal point, else nanoseconds (or a count)."""
    try:
        return ns_from_text(text) if text.lstrip("-").isdigit() else ns_from_seconds(text)
    except ValueError:
        raise SourceError(f"{where}: {text!r} is no time stamp") from None
