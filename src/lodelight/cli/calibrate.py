"""`lodelight calibrate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lodelight.tags.calibrate import Calibration
    from lodelight.types import Bytes

app = typer.Typer(add_completion=False)
RIM_PX = 0.5  # error in a region above which the lens is said to be not of this model


@app.command(epilog="Example: lodelight calibrate board.mp4 --out rig.toml")
def calibrate(
    source: Path = typer.Argument(..., help="Folder of images, image, video, or recording of the printed board."),
    out: Path = typer.Option(..., help="rig.toml to write."),
    board: str = typer.Option("", help="What was printed, as on its foot: tag36h11:6x8:24/7.2mm."),
    size_mm: float = typer.Option(0.0, min=0.0, help="Side of a tag as measured on the paper, if the printer scaled."),
    model: str = typer.Option("radtan", help="radtan, or equidistant for fisheye lenses."),
    every: int = typer.Option(5, min=1, help="Of a video or recording, so manyeth frame."),
    rate: float = typer.Option(0.0, min=0.0, help="Images per second, written into the rig."),
    as_json: bool = typer.Option(False, "--json", help="Print the result as JSON."),
) -> None:
    """Find a camera's lens from images of a printed tag board (`tags print --board default`)."""
    from dataclasses import replace

    from lodelight.cli.progress import track
    from lodelight.errors import ConfigError
    from lodelight.geometry.se3 import SE3
    from lodelight.io.rig_toml import write_rig
    from lodelight.rig import CameraSpec, Rig
    from lodelight.tagboard import TagBoard
    from lodelight.tags.calibrate import calibrate as solve
    from lodelight.tags.calibrate import find_board

    if model not in ("radtan", "equidistant"):
        raise ConfigError(f"--model {model!r} is unknown; choose radtan or equidistant")
    printed = TagBoard.parse(board) if board else TagBoard()
    if size_mm > 0.0:  # the gaps were scaled as well
        k = 1e-3 * size_mm / printed.size_m
        printed = replace(printed, size_m=k * printed.size_m, gap_m=k * printed.gap_m)
    views, size, count = find_board(track(images_of(source, every), "looking for the board"), printed)
    found = solve(views, size, printed, model)
    write_rig(out, Rig((CameraSpec("cam0", found.camera, SE3.identity(), rate_hz=rate),)))
    print(json.dumps(_as_dict(found)) if as_json else _summary(found, count, out))


def images_of(source: Path, every: int) -> Iterator[tuple[str, Bytes]]:
    """Named grey images of a file, a folder, a video, or camera 0 of a recording. Raises SourceError on none."""
    from lodelight.errors import SourceError
    from lodelight.io.pictures import SUFFIXES
    from lodelight.io.sources import open_source
    from lodelight.io.video import SUFFIXES as VIDEOS

    if not source.exists():
        raise SourceError(f"{source} does not exist; give images, a video or a recording of the board")
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    files = [file for file in files if file.suffix.lower() in SUFFIXES]
    if files:
        yield from ((file.name, _grey(file)) for file in files)
        return
    if source.suffix.lower() in VIDEOS:
        yield from _video(source, every)
        return
    for i, frame in enumerate(open_source(source).frames(1, False)):
        if i % every == 0:
            yield str(frame.t_ns), frame.images[0]


def _grey(file: Path) -> Bytes:
    from lodelight.errors import SourceError
    from lodelight.io.pictures import BadFrame, read_grey

    try:
        return read_grey(file)
    except BadFrame as bad:
        raise SourceError(f"{file}: {bad}") from None


def _video(source: Path, every: int) -> Iterator[tuple[str, Bytes]]:
    import cv2
    import numpy as np

    from lodelight.errors import SourceError

    video = cv2.VideoCapture(str(source))
    try:
        i, more = 0, video.grab()
        if not more:
            raise SourceError(f"{source} is no video that can be read; convert it to mp4, or to images")
        while more:
            if i % every == 0:
                _, image = video.retrieve()
                grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
                yield f"frame {i}", np.asarray(grey, np.uint8)
            i, more = i + 1, video.grab()
    finally:
        video.release()


def _as_dict(found: Calibration) -> dict[str, Any]:
    from lodelight.report.plain import plain

    camera = found.camera
    told: dict[str, Any] = plain(
        {
            "model": camera.model_name, "size": [camera.width, camera.height], "intrinsics": camera.params[:4],
            "distortion": camera.distortion, "rms_px": found.rms_px, "sigma_focal_px": found.sigma_focal_px,
            "views": found.views, "left_out": found.left_out, "regions_px": found.regions_px, "covered": found.covered,
        }
    )  # fmt: skip
    return told


def _summary(found: Calibration, images: int, out: Path) -> str:
    import numpy as np

    fx, fy, cx, cy = found.camera.params[:4]
    lines = [
        f"{found.views} of {images} images used, the board seen in {found.covered:.0%} of the image",
        f"fx {fx:.2f} fy {fy:.2f} cx {cx:.2f} cy {cy:.2f} px, +- {found.sigma_focal_px:.2f} in focal length",
        f"{found.camera.model_name} {' '.join(f'{v:.5f}' for v in found.camera.distortion)}",
        f"reprojection error {found.rms_px:.3f} px; by region of the image:",
    ]
    lines += ["   " + "  ".join("  -  " if np.isnan(v) else f"{v:5.3f}" for v in row) for row in found.regions_px]
    lines += [f"left out: {text}" for text in found.left_out]
    if np.nanmax(found.regions_px) > RIM_PX:
        lines.append("some regions fit badly: was the board flat and sharp, and is this the right --model?")
    return "\n".join([*lines, f"written to {out}"])
