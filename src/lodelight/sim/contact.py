"""A contact sheet: two dozen frames of a recording on one picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from lodelight.errors import SourceError

COLUMNS, ROWS, WIDTH_PX = 6, 4, 320


def write_contact_sheet(out: Path, camera: str = "cam0") -> Path:
    """`contact_sheet.png` in a recording's folder, from the images that are there, evenly in time."""
    images = sorted((out / "mav0" / camera / "data").glob("*.png"), key=lambda p: int(p.stem))
    if not images:
        raise SourceError(f"{out} has no images of {camera}")
    start = int(images[0].stem)
    picked = [images[round(i)] for i in np.linspace(0, len(images) - 1, min(len(images), COLUMNS * ROWS))]
    tiles = []
    for path in picked:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SourceError(f"{path} is no image")
        tile = cv2.resize(image, (WIDTH_PX, WIDTH_PX * image.shape[0] // image.shape[1]), interpolation=cv2.INTER_AREA)
        text = f"{(int(path.stem) - start) * 1e-9:.1f} s"
        for grey, thick in ((0, 3), (255, 1)):
            cv2.putText(tile, text, (6, tile.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, grey, thick, cv2.LINE_AA)
        tiles.append(tile)
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    sheet = np.vstack([np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)])
    target = out / "contact_sheet.png"
    try:
        target.write_bytes(cv2.imencode(".png", sheet)[1].tobytes())
    except OSError as error:
        raise SourceError(f"cannot write {target}: {error.strerror}; make room") from None
    return target
