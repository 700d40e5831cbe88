"""Typed access to the tables of a TOML or YAML file, with errors that name the file, the key and the remedy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lodelight.errors import CalibrationError
from lodelight.geometry.se3 import SE3
from lodelight.types import Array


class Section:
    """One table of a file. `where` is its path for messages: `rig.toml: camera[0]`.

    Every reader of a key raises CalibrationError where it is missing or not what it must be.
    """

    def __init__(self, data: Any, where: str) -> None:
        if not isinstance(data, dict):
            raise CalibrationError(f"{where} must be a table of keys, not {_shown(data)}")
        self.data: dict[str, Any] = data
        self.where = where
        self._read: set[str] = set()

    def __contains__(self, key: str) -> bool:
        self._read.add(key)
        return key in self.data

    def at(self, key: str) -> str:
        """The key's path for messages."""
        return f"{self.where}.{key}" if not self.where.endswith(":") else f"{self.where} {key}"

    def value(self, key: str) -> Any:
        self._read.add(key)
        if key not in self.data:
            raise CalibrationError(f"{self.at(key)} is missing; add it")
        return self.data[key]

    def number(self, key: str, default: float | None = None, minimum: float = -math.inf) -> float:
        """A finite number; the default where the key is absent and there is one."""
        if key not in self and default is not None:
            return default
        value = self.value(key)
        if not _is_finite(value) or value < minimum:
            least = f" of at least {minimum:g}" if minimum > -math.inf else ""
            raise CalibrationError(f"{self.at(key)} must be a number{least}, not {_shown(value)}")
        return float(value)

    def numbers(self, key: str, count: int | None = None) -> tuple[float, ...]:
        """A list of finite numbers, of `count` if given."""
        value = self.value(key)
        wanted = f"a list of {count} numbers" if count else "a list of numbers"
        if not isinstance(value, Sequence) or isinstance(value, str) or (count and len(value) != count):
            raise CalibrationError(f"{self.at(key)} must be {wanted}, not {_shown(value)}")
        for v in value:
            if not _is_finite(v):
                raise CalibrationError(f"{self.at(key)} must be {wanted}, all finite; it has {_shown(v)}")
        return tuple(float(v) for v in value)

    def text(self, key: str) -> str:
        value = self.value(key)
        if not isinstance(value, str):
            raise CalibrationError(f"{self.at(key)} must be a text, not {_shown(value)}")
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self.value(key) if key in self else default
        if not isinstance(value, bool):
            raise CalibrationError(f"{self.at(key)} must be true or false, not {_shown(value)}")
        return value

    def table(self, key: str) -> Section:
        return Section(self.value(key), self.at(key))

    def size(self, key: str) -> tuple[int, int]:
        """(width, height) in px."""
        width, height = self.numbers(key, 2)
        if width != int(width) or height != int(height) or width < 1 or height < 1:
            raise CalibrationError(f"{self.at(key)} must be a width and a height in px, not {_shown(self.data[key])}")
        return int(width), int(height)

    def matrix(self, key: str) -> Array:
        """A matrix of finite numbers, as rows of numbers or as `rows`, `cols`, `data` (EuRoC, ROS, OpenCV)."""
        value = self.value(key)
        if isinstance(value, dict):
            inner = self.table(key)
            shape = int(inner.number("rows", minimum=0)), int(inner.number("cols", minimum=0))
            data = np.array(inner.numbers("data"))
            if data.size != shape[0] * shape[1]:
                raise CalibrationError(f"{inner.at('data')} has {data.size} numbers, not {shape[0]} x {shape[1]}")
            return data.reshape(shape)
        try:
            matrix = np.array(value, dtype=np.float64)
        except (ValueError, TypeError):
            matrix = np.empty(0)
        if matrix.ndim != 2 or not np.isfinite(matrix).all():
            raise CalibrationError(f"{self.at(key)} must be a matrix of finite numbers, row by row")
        return matrix

    def motion(self, key: str) -> SE3:
        """A rigid motion from a 4x4 or 3x4 matrix."""
        return rigid_motion(self.matrix(key), self.at(key))

    def only_known(self) -> None:
        """Raises on a key that nothing has asked for."""
        unknown = [key for key in self.data if key not in self._read]
        if unknown:
            known = ", ".join(sorted(self._read))
            raise CalibrationError(f"{self.at(unknown[0])} is unknown; remove it or choose one of {known}")


def rigid_motion(matrix: Array, where: str) -> SE3:
    """SE3 of a 4x4 or 3x4 matrix: exactly its numbers where they are a rotation to rounding, else the nearest.

    Raises CalibrationError where they are farther from one than a few written digits explain.
    """
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise CalibrationError(f"{where} must be a 4x4 matrix of finite numbers, row by row")
    R = matrix[:3, :3]
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > 1e-2 or np.linalg.det(R) < 0 or (len(matrix) == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9):
        raise CalibrationError(f"{where} is no rigid motion: its rotation part is not orthonormal (off by {off:.2g})")
    if off < 1e-12:
        return SE3(np.ascontiguousarray(R), matrix[:3, 3].copy())
    return SE3.from_matrix(matrix)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
