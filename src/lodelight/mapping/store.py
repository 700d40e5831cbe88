"""The map file: one SQLite database, each table of the map in blocks of rows with a checksum. See docs/map-file.md.

The layout follows `Map.tables`: a new column needs no code here, but a new VERSION, and a line in ADDED so that older
files can still be read.
"""

from __future__ import annotations

import json
import math
import sqlite3
import zlib
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from lodelight import __version__
from lodelight.errors import MapError
from lodelight.io.rig_toml import format_rig, parse_rig
from lodelight.mapping import invariants
from lodelight.mapping.compact import compacted
from lodelight.mapping.map import Map
from lodelight.mapping.mapfile import ADVICE, APPLICATION_ID, VERSION, DamagedMap, reading, replacing
from lodelight.mapping.table import Table
from lodelight.types import AnyArray

PAGE_BYTES = 16384
BLOCK_ROWS = 4096
ADDED: dict[tuple[str, str], float] = {}  # (table, column) that came after version 1: its value in older files

Columns = dict[str, AnyArray]


def save_map(map: Map, path: str | Path, notes: Mapping[str, str | int | float] | None = None) -> None:
    """Write the map file whole, or raise MapError and leave the earlier file as it was.

    Only what is alive is written, numbered without gaps (see `compacted`); the map itself is not changed, and is
    locked only while it is copied. Equal maps and notes give equal bytes: no clock goes in.
    notes : what else `map_info` shall tell, such as seed and source
    """
    path = Path(path)
    with map.lock:
        if problems := invariants.structure(map):
            raise MapError(f"the map contradicts itself ({problems[0]}): a bug, please report it; {path} is as it was")
        snapshot = compacted(map)
    try:
        with replacing(path) as temporary, closing(sqlite3.connect(temporary, isolation_level=None)) as db:
            _write(db, snapshot, dict(notes or {}))
    except sqlite3.Error as error:
        raise MapError(f"cannot save map {path}: {error}; make room or choose another place") from None
    except OSError as error:
        raise MapError(f"cannot save map {path}: {error.strerror}; make room or choose another place") from None


def load_map(path: str | Path) -> Map:
    """The map of a file, which is opened read-only.

    Raises MapError where it is missing, no map, newer, truncated, corrupt, or would lead a kernel out of bounds.
    """
    map = _read(Path(path))
    if problems := invariants.structure(map):
        raise DamagedMap(f"map {path} contradicts itself ({problems[0]}); {ADVICE}")
    return map


def map_info(path: str | Path) -> dict[str, Any]:
    """What a map file says of itself, read without its blocks: counts, extents, sensors, versions, notes."""
    path = Path(path)
    with reading(path) as db:
        meta = _meta(db, path)
        version = db.execute("PRAGMA user_version").fetchone()[0]
    about = {"path": str(path), "bytes": path.stat().st_size, "format": version, "lodelight": meta["lodelight"]}
    return {**about, **json.loads(meta["summary"]), "notes": json.loads(meta["notes"])}


def check_map(path: str | Path) -> list[str]:
    """All that is wrong with a map file, one line each; none is good.

    Raises MapError where the file is no map at all, or newer.
    """
    path = Path(path)
    try:
        with reading(path) as db:
            found = [str(row[0]) for row in db.execute("PRAGMA integrity_check")]
        return [line for line in found if line != "ok"] + invariants.problems(_read(path))
    except DamagedMap as error:
        return [str(error)]


# -- writing ----------------------------------------------------------------------------------------------------


def _write(db: sqlite3.Connection, map: Map, notes: dict[str, str | int | float]) -> None:
    # Nobody sees the file before it is complete and synced, so SQLite need not guard every step of its own.
    for pragma in ("journal_mode = OFF", "synchronous = OFF", "auto_vacuum = NONE", f"page_size = {PAGE_BYTES}"):
        db.execute(f"PRAGMA {pragma}")
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    db.execute(f"PRAGMA user_version = {VERSION}")
    db.execute("BEGIN")
    db.execute("CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, crc32 INTEGER NOT NULL) WITHOUT ROWID")
    meta = {
        "lodelight": __version__,
        "layout": json.dumps({name: _layout(table) for name, table in map.tables.items()}),
        "notes": json.dumps(notes),
        "rig": format_rig(map.rig),
        "summary": json.dumps(_summary(map)),
    }
    db.executemany(
        "INSERT INTO meta VALUES (?, ?, ?)", [(key, text, _checksum(key, text.encode())) for key, text in meta.items()]
    )
    for name, table in map.tables.items():
        db.execute(
            f"CREATE TABLE {name} (first_row INTEGER PRIMARY KEY, n_rows INTEGER NOT NULL, crc32 INTEGER NOT NULL, "
            "data BLOB NOT NULL)"
        )
        columns = [_little_endian(column) for column in table.columns.values()]
        db.executemany(f"INSERT INTO {name} VALUES (?, ?, ?, ?)", _packed(name, columns, _blocks(map, name)))
    db.execute("COMMIT")


def _layout(table: Table) -> dict[str, Any]:
    columns = {name: [_little_endian(c).dtype.str, list(c.shape[1:])] for name, c in table.columns.items()}
    return {"rows": len(table), "columns": columns}


def _little_endian(column: AnyArray) -> AnyArray:
    return column.astype(column.dtype.newbyteorder("<"), copy=False)


def _blocks(map: Map, name: str) -> Iterator[tuple[int, int]]:
    """(first row, rows) of each block: one per keyframe for the features, so that one keyframe can be read alone."""
    if name == "features":
        k = map.keyframes
        yield from ((first, n) for first, n in zip(k.first_feature.tolist(), k.n_features.tolist(), strict=True) if n)
    else:
        rows = len(map.tables[name])
        yield from ((first, min(BLOCK_ROWS, rows - first)) for first in range(0, rows, BLOCK_ROWS))


def _packed(
    name: str, columns: list[AnyArray], blocks: Iterator[tuple[int, int]]
) -> Iterator[tuple[int, int, int, bytes]]:
    for first, n in blocks:
        data = b"".join(column[first : first + n].tobytes() for column in columns)
        yield first, n, _checksum(f"{name} {first} {n}", data), data


def _checksum(place: str, data: bytes) -> int:
    """CRC-32 of a value and of where it stands, since SQLite has none of its own."""
    return zlib.crc32(data, zlib.crc32(place.encode()))


def _summary(map: Map) -> dict[str, Any]:
    k, xyz, rig = map.keyframes, map.points.xyz, map.rig
    return {name: len(table) for name, table in map.tables.items()} | {
        "observations": int(np.count_nonzero(map.features.point >= 0)),
        "sensors": rig.sensors,
        "cameras": [f"{c.name} {c.camera.model_name} {c.camera.width}x{c.camera.height}" for c in rig.cameras],
        "first_t_ns": int(k.t_ns.min()) if len(k) else None,
        "last_t_ns": int(k.t_ns.max()) if len(k) else None,
        "path_m": float(np.linalg.norm(np.diff(k.p, axis=0), axis=1).sum()),
        "bounds_m": [xyz.min(axis=0).tolist(), xyz.max(axis=0).tolist()] if len(xyz) else None,
    }


# -- reading ----------------------------------------------------------------------------------------------------


def _read(path: Path) -> Map:
    with reading(path) as db:
        meta = _meta(db, path)
        layout = json.loads(meta["layout"])
        map = Map(parse_rig(meta["rig"], f"rig of map {path}"))
        _check_layout(path, layout, map, meta["lodelight"])
        for name, table in map.tables.items():
            if name in layout:
                _fill(db, path, name, table, layout[name])
    return map


def _meta(db: sqlite3.Connection, path: Path) -> dict[str, str]:
    rows = db.execute("SELECT key, value, crc32 FROM meta").fetchall()
    for key, value, checksum in rows:
        if not isinstance(value, str) or _checksum(str(key), value.encode()) != checksum:
            raise DamagedMap(f"map {path} is corrupt in its {key!s}; {ADVICE}")
    meta = {key: value for key, value, _ in rows}
    if missing := {"lodelight", "layout", "notes", "rig", "summary"} - set(meta):
        raise DamagedMap(f"map {path} has lost its {sorted(missing)[0]}; {ADVICE}")
    return meta


def _check_layout(path: Path, layout: dict[str, Any], map: Map, version: str) -> None:
    """What the file has must be known here, and what it has not must have a value for files that old."""
    there = {(name, column) for name, table in layout.items() for column in table["columns"]}
    known = {(name, column) for name, table in map.tables.items() if name in layout for column in table.columns}
    wrong = sorted(there - known) or sorted(known - there - set(ADDED))
    if wrong:
        verb = "has" if wrong[0] in there else "lacks"
        raise MapError(
            f"map {path} {verb} the column {'.'.join(wrong[0])}, unlike maps of lodelight {__version__}; "
            f"use lodelight {version}, or map again"
        )


def _fill(db: sqlite3.Connection, path: Path, name: str, table: Table, layout: dict[str, Any]) -> None:
    """Read the blocks of a table into it, which must cover its rows without gap."""
    table.append(layout["rows"], **{column: value for (of, column), value in ADDED.items() if of == name})
    columns = table.columns
    parts = [(columns[c], np.dtype(dtype), tuple(shape)) for c, (dtype, shape) in layout["columns"].items()]
    row_bytes = sum(dtype.itemsize * math.prod(shape) for _, dtype, shape in parts)
    done = 0
    for first, n, checksum, data in db.execute(f"SELECT first_row, n_rows, crc32, data FROM {name} ORDER BY 1"):
        whole = isinstance(data, bytes) and _checksum(f"{name} {first} {n}", data) == checksum
        if not whole or first != done or len(data) != n * row_bytes:
            raise DamagedMap(f"map {path} is corrupt in its {name}, row {done} on; {ADVICE}")
        offset = 0
        for column, dtype, shape in parts:
            count = n * math.prod(shape)
            column[first : first + n] = np.frombuffer(data, dtype, count, offset).reshape(n, *shape)
            offset += count * dtype.itemsize
        done += n
    if done != layout["rows"]:
        raise DamagedMap(f"map {path} has {done} of its {layout['rows']} {name}; {ADVICE}")
