"""Values as JSON and TOML can hold them."""

from __future__ import annotations

import dataclasses
import json
import math
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np

from lodelight.geometry.se3 import SE3


def plain(value: Any) -> Any:
    """Numbers, texts, lists and dicts of them: numpy's types, dataclasses, poses and paths made so.

    What is no finite number becomes None, for JSON has no word for it. A pose becomes its xyz and quat_xyzw.
    """
    if value is None or isinstance(value, bool | int | str):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, SE3):
        return {"xyz": plain(value.t), "quat_xyzw": plain(value.quat_xyzw)}
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no plain form")


def json_line(value: dict[str, Any]) -> str:
    """One line of JSON, keys in the order given."""
    return json.dumps(plain(value), ensure_ascii=False, allow_nan=False) + "\n"
