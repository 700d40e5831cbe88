"""The outside of a map file: what makes a file a map, how one is opened without touching it, and replaced at once."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from lodelight.errors import MapError

APPLICATION_ID = 0x4C4F4445  # "LODE"
VERSION = 1
HEADER_BYTES = 100
ADVICE = "take an earlier copy of it or map again"


class DamagedMap(MapError):
    """A map file that is truncated or corrupt: it was a map once."""


@contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """The open database, read-only and immutable: SQLite takes no lock and leaves no file beside it.

    Raises MapError where the file is missing, no map, or newer; DamagedMap where SQLite trips over what is inside.
    """
    check_header(path)
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as db:
            yield db
    except (sqlite3.Error, UnicodeDecodeError) as error:  # the second where the broken schema cannot even be quoted
        raise DamagedMap(f"map {path} is corrupt ({error}); {ADVICE}") from None


def check_header(path: Path) -> None:
    """Read the first 100 bytes as SQLite's file format defines them; raises as `reading`."""
    try:
        with open(path, "rb") as file:
            header = file.read(HEADER_BYTES)
            size = os.fstat(file.fileno()).st_size
    except FileNotFoundError:
        raise MapError(f"map {path} does not exist; check the path") from None
    except IsADirectoryError:
        raise MapError(f"map {path} is a folder; name the map file itself, for example {path / 'map.lode'}") from None
    except OSError as error:
        raise MapError(f"cannot read map {path}: {error.strerror}; check the path and its permissions") from None
    if not header:
        raise MapError(f"map {path} is empty; {ADVICE}")
    if len(header) < HEADER_BYTES or not header.startswith(b"SQLite format 3\0"):
        raise MapError(f"{path} is not a map; name a map.lode that lodelight wrote")

    def number(start: int, end: int) -> int:
        return int.from_bytes(header[start:end], "big")

    if number(68, 72) != APPLICATION_ID:
        raise MapError(f"{path} is an SQLite database but not a map; name a map.lode that lodelight wrote")
    if number(60, 64) > VERSION:
        raise MapError(
            f"map {path} has format {number(60, 64)}, this lodelight reads up to {VERSION}; update lodelight"
        )
    page = 65536 if number(16, 18) == 1 else number(16, 18)
    if size < page * number(28, 32):
        raise DamagedMap(f"map {path} is truncated: {size} of {page * number(28, 32)} bytes are left; {ADVICE}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to. What was written takes the place of `path` at once, safe on the disk.

    Until then, and after a kill or a full disk at any moment, the earlier file stands untouched; its permissions pass
    to the new one. A failed save removes what it wrote; what a killed one left is removed by the next of that map.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise MapError(f"cannot save a map to {path}, it is a folder; name a file in it")
    path = path.resolve()  # where a link leads, not the link
    temporary = path.with_name(f".{path.name}.saving")
    with _only_saver_in(path.parent) as folder:
        temporary.unlink(missing_ok=True)
        try:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            if path.exists():
                shutil.copymode(path, temporary)
            os.replace(temporary, path)
            if folder is not None:
                os.fsync(folder)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def _only_saver_in(folder: Path) -> Iterator[int | None]:
    """Wait for other savers in the folder, so that a leftover is nobody's; yields the folder's descriptor."""
    if sys.platform == "win32":  # folders can be neither locked nor synced there
        yield None
        return
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems lock no folders; a lone saver needs no lock
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)
