"""Text files as recordings come with: tables of numbers after a stamp, written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.types import Array


def read_text(path: Path) -> str:
    """The file's text; SourceError where it is missing, unreadable or not text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SourceError(f"{path} does not exist") from None
    except UnicodeDecodeError:
        raise SourceError(f"{path} is not a text file") from None
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from None


def lines(path: Path) -> Iterator[tuple[int, str]]:
    """(line number, line) of each line that is neither empty nor a comment."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def fields(line: str) -> list[str]:
    """What stands between the commas of a line, or between its blanks where it has no comma."""
    return [field.strip() for field in line.split(",")] if "," in line else line.split()


@dataclass(frozen=True, eq=False)
class Table:
    """Stamped rows of numbers. t_ns : (N,); values : (N, columns); bad : line numbers that are not such rows."""

    t_ns: NDArray[np.int64]
    values: Array
    bad: tuple[int, ...]


def read_table(path: Path, columns: int, stamp: Callable[[str], int]) -> Table:
    """Rows of a stamp and at least `columns` finite numbers, in the file's order; further fields are left alone."""
    t_ns: list[int] = []
    values: list[list[float]] = []
    bad: list[int] = []
    for number, line in lines(path):
        found = fields(line)
        try:
            t = stamp(found[0])
            row = [float(field) for field in found[1 : columns + 1]]
        except ValueError:
            bad.append(number)
            continue
        if len(row) < columns or not np.isfinite(row).all():
            bad.append(number)
            continue
        t_ns.append(t)
        values.append(row)
    return Table(np.array(t_ns, dtype=np.int64), np.array(values).reshape(-1, columns), tuple(bad))


def read_files(path: Path, stamp: Callable[[str], int]) -> tuple[NDArray[np.int64], list[str], tuple[int, ...]]:
    """Rows of a stamp and a file name: stamps (N,), names, and the numbers of the lines that are not such rows."""
    t_ns: list[int] = []
    names: list[str] = []
    bad: list[int] = []
    for number, line in lines(path):
        found = fields(line)
        try:
            t, name = stamp(found[0]), found[1]
        except (ValueError, IndexError):
            bad.append(number)
            continue
        t_ns.append(t)
        names.append(name)
    return np.array(t_ns, dtype=np.int64), names, tuple(bad)


def write_text(path: Path, text: str) -> None:
    """Write the whole file or leave what was there: a reader never meets half of it."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write the whole file or leave what was there; SourceError where that fails."""
    path = Path(path)
    temporary = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("wb", dir=path.parent, delete=False) as file:
            temporary = file.name
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)  # a temporary file is private; what it becomes is not
        os.replace(temporary, path)
    except OSError as error:
        if temporary:
            with suppress(OSError):
                Path(temporary).unlink(missing_ok=True)
        raise SourceError(f"cannot write {path}: {error.strerror}; choose another place or make room") from None
