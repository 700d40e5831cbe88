"""Occupancy grids as ROS map_server and nav2 read them: a PGM picture and a YAML file beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lodelight.io.text import write_bytes, write_text
from lodelight.types import AnyArray

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # of nav_msgs/OccupancyGrid
GREY = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
FREE_THRESH = 0.196  # map_server's: just below (255 - 205) / 255, so that unknown stays unknown


def write_occupancy(
    path: str | Path, cells: AnyArray, resolution_m: float, origin_xy_m: tuple[float, float], remarks: str = ""
) -> None:
    """`PATH.yaml` and `PATH.pgm`, whatever suffix the path has.

    cells : (rows, columns) of UNKNOWN, FREE, OCCUPIED; row 0 has the lowest y, column 0 the lowest x
    origin_xy_m : the outer corner of that first cell; remarks : lines that become comments of the YAML file
    """
    path = Path(path)
    picture = np.zeros(cells.shape, np.uint8)
    for value, grey in GREY.items():
        picture[cells == value] = grey
    rows, columns = cells.shape
    write_bytes(path.with_suffix(".pgm"), f"P5\n{columns} {rows}\n255\n".encode() + picture[::-1].tobytes())
    comments = "".join(f"# {line}\n" for line in remarks.splitlines())
    write_text(
        path.with_suffix(".yaml"),
        f"{comments}image: {path.with_suffix('.pgm').name}\nmode: trinary\nresolution: {resolution_m!r}\n"
        f"origin: [{origin_xy_m[0]:.6f}, {origin_xy_m[1]:.6f}, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
        f"free_thresh: {FREE_THRESH}\n",
    )
