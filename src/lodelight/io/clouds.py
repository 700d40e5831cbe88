"""Point cloud files: binary PLY and PCD, little-endian, readable by CloudCompare, MeshLab, PCL and Open3D."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lodelight.errors import SourceError
from lodelight.io.text import write_bytes
from lodelight.types import AnyArray

PLY_TYPES = {"f4": "float", "i4": "int", "u4": "uint", "u2": "ushort", "u1": "uchar"}


def write_ply(
    path: str | Path,
    xyz: AnyArray,
    normal: AnyArray | None = None,
    comments: Iterable[str] = (),
    **attributes: AnyArray,
) -> None:
    """Points (N, 3) m, their unit normals (N, 3), and further properties (N,) by name, of float or integer type.

    comments : lines of the header, in which what is not plain ASCII becomes a question mark
    """
    rows = _rows(xyz, normal, ("nx", "ny", "nz"), attributes)
    properties = "".join(f"property {PLY_TYPES[rows.dtype[name].str[1:]]} {name}\n" for name in rows.dtype.names or ())
    said = "".join(f"comment {' '.join(text.split())}\n" for text in comments)
    header = f"ply\nformat binary_little_endian 1.0\n{said}element vertex {len(rows)}\n{properties}end_header\n"
    write_bytes(Path(path), header.encode("ascii", "replace") + rows.tobytes())


def write_pcd(path: str | Path, xyz: AnyArray, normal: AnyArray | None = None, **attributes: AnyArray) -> None:
    """As `write_ply`, in the Point Cloud Library's format, version 0.7."""
    rows = _rows(xyz, normal, ("normal_x", "normal_y", "normal_z"), attributes)
    names = rows.dtype.names or ()
    header = {
        "VERSION": "0.7",
        "FIELDS": " ".join(names),
        "SIZE": " ".join(str(rows.dtype[name].itemsize) for name in names),
        "TYPE": " ".join(rows.dtype[name].kind.upper() for name in names),
        "COUNT": " ".join("1" for _ in names),
        "WIDTH": len(rows),
        "HEIGHT": 1,
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": len(rows),
        "DATA": "binary",
    }
    text = "".join(f"{key} {value}\n" for key, value in header.items())
    write_bytes(Path(path), text.encode("ascii") + rows.tobytes())


def read_ply(path: str | Path) -> AnyArray:
    """Points (N, 3) m of a PLY file. Raises SourceError where it is none, or has no x, y, z."""
    from plyfile import PlyData, PlyParseError

    try:
        vertex = PlyData.read(str(path))["vertex"].data
        return np.column_stack([vertex[name] for name in "xyz"])
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError):
        raise SourceError(f"{path} is no point cloud in PLY with x, y, z") from None


def _rows(
    xyz: AnyArray, normal: AnyArray | None, normal_names: tuple[str, str, str], attributes: dict[str, AnyArray]
) -> AnyArray:
    """One record per point; floats of any width become 32-bit ones (a micrometre at 10 m), as readers expect."""
    columns = dict(zip(("x", "y", "z"), np.asarray(xyz).reshape(-1, 3).T, strict=True))
    if normal is not None:
        columns |= dict(zip(normal_names, np.asarray(normal).reshape(-1, 3).T, strict=True))
    columns |= {name: np.asarray(values) for name, values in attributes.items()}
    kinds = {name: "<f4" if c.dtype.kind == "f" else c.dtype.newbyteorder("<").str for name, c in columns.items()}
    if unknown := [name for name, kind in kinds.items() if kind[1:] not in PLY_TYPES]:
        raise SourceError(
            f"a point cloud cannot hold {unknown[0]} of type {kinds[unknown[0]]}; make it float32 or int32"
        )
    rows = np.empty(len(columns["x"]), list(kinds.items()))
    for name, column in columns.items():
        rows[name] = column
    return rows
