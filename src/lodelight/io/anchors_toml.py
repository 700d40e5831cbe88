"""`anchors.toml`: what is known of the building."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.anchors import Anchors, Light, Tag
from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io.text import read_text, write_text
from lodelight.types import Array

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_WORD = 32
TAG_KEYS = {"family", "id", "size_m", "xyz", "quat_xyzw", "sigma_m"}
LIGHT_KEYS = {"id", "frequency_hz", "xyz", "normal", "radius_m", "sigma_m", "word"}


def read_anchors(path: str | Path) -> Anchors:
    """The tags and lights of a file. Raises SourceError with the entry and the key that is wrong."""
    path = Path(path)
    try:
        tables = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise SourceError(f"{path} is not TOML: {error}") from None
    unknown = set(tables) - {"tag", "light"}
    if unknown:
        raise SourceError(f"{path}: unknown table {sorted(unknown)[0]!r}; anchors are [[tag]] and [[light]]")
    tags = tuple(_tag(entry, f"{path} tag {i}") for i, entry in enumerate(_entries(tables, "tag", path), 1))
    lights = tuple(_light(entry, f"{path} light {i}") for i, entry in enumerate(_entries(tables, "light", path), 1))
    return Anchors(tags, lights)


def write_anchors(path: str | Path, anchors: Anchors) -> None:
    """Write the file whole; floats keep their full value."""
    import tomli_w

    tags = []
    for tag in anchors.tags:
        entry: dict[str, Any] = {"family": tag.family, "id": tag.id, "size_m": tag.size_m}
        if tag.T_world_tag is not None:
            entry |= {"xyz": tag.T_world_tag.t.tolist(), "quat_xyzw": tag.T_world_tag.quat_xyzw.tolist()}
            entry["sigma_m"] = tag.sigma_m
        tags.append(entry)
    lights = [
        {
            "id": light.id,
            "frequency_hz": light.frequency_hz,
            "xyz": light.xyz.tolist(),
            "normal": light.normal.tolist(),
            "radius_m": light.radius_m,
            "sigma_m": light.sigma_m,
        }
        | ({"word": light.word} if light.word else {})
        for light in anchors.lights
    ]
    write_text(Path(path), tomli_w.dumps({"tag": tags, "light": lights}))


def _entries(tables: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    entries = tables.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise SourceError(f"{path}: {key} must be an array of tables; write [[{key}]] before each entry")
    return entries


def _tag(entry: dict[str, Any], where: str) -> Tag:
    _check_keys(entry, TAG_KEYS, {"family", "id", "size_m"}, where)
    pose = None
    if ("xyz" in entry) != ("quat_xyzw" in entry):
        raise SourceError(f"{where}: xyz and quat_xyzw must come together, or both be left out")
    if "xyz" in entry:
        quat = _vector(entry, "quat_xyzw", 4, where)
        if abs(float(np.linalg.norm(quat)) - 1.0) > 0.01:
            raise SourceError(f"{where}: quat_xyzw has length {np.linalg.norm(quat):.3g}; a rotation's is 1")
        pose = SE3.from_quat_xyzw(_vector(entry, "xyz", 3, where), quat)
    size, sigma = _positive(entry, "size_m", where), _positive({"sigma_m": 0.005} | entry, "sigma_m", where)
    return Tag(str(entry["family"]), str(entry["id"]), size, pose, sigma)


def _light(entry: dict[str, Any], where: str) -> Light:
    _check_keys(entry, LIGHT_KEYS, {"id", "frequency_hz", "xyz"}, where)
    full = {"normal": [0.0, 0.0, -1.0], "radius_m": 0.09, "sigma_m": 0.005} | entry
    normal = _vector(full, "normal", 3, where)
    length = float(np.linalg.norm(normal))
    if length < 1e-6:
        raise SourceError(f"{where}: normal is zero; give the direction in which the light shines")
    return Light(
        str(entry["id"]),
        _positive(full, "frequency_hz", where),
        _vector(full, "xyz", 3, where),
        normal / length,
        _positive(full, "radius_m", where),
        _positive(full, "sigma_m", where),
        _word(entry, where),
    )


def _word(entry: dict[str, Any], where: str) -> str:
    word = entry.get("word", "")
    if not isinstance(word, str) or set(word) - {"0", "1"} or len(word) > MAX_WORD:
        raise SourceError(f'{where}: word must be up to {MAX_WORD} bits in quotes, as "01101001", got {word!r}')
    return word


def _check_keys(entry: dict[str, Any], known: set[str], needed: set[str], where: str) -> None:
    if unknown := set(entry) - known:
        raise SourceError(f"{where}: unknown key {sorted(unknown)[0]!r}; known are {', '.join(sorted(known))}")
    if missing := needed - set(entry):
        raise SourceError(f"{where} has no {sorted(missing)[0]}")


def _positive(entry: dict[str, Any], key: str, where: str) -> float:
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value <= 0:
        raise SourceError(f"{where}: {key} must be a positive number, got {value!r}")
    return float(value)


def _vector(entry: dict[str, Any], key: str, length: int, where: str) -> Array:
    try:
        values = np.array(entry[key], dtype=np.float64)
    except (TypeError, ValueError):
        raise SourceError(f"{where}: {key} must be {length} numbers, got {entry[key]!r}") from None
    if values.shape != (length,) or not np.isfinite(values).all():
        raise SourceError(f"{where}: {key} must be {length} finite numbers, got {entry[key]!r}")
    return values
