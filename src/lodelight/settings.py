"""Settings are nested frozen dataclasses; this turns them into tables and applies `section.key=value` to them."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any, TypeVar

from lodelight.errors import ConfigError

C = TypeVar("C")


def as_table(config: Any) -> dict[str, Any]:
    """Nested plain dict of a settings dataclass, for TOML."""
    return dataclasses.asdict(config)


def with_settings(config: C, assignments: list[str]) -> C:
    """The settings with `section.key=value` texts applied in order.

    Raises ConfigError on an unknown key, naming those there are, and on a value that is not of the key's type.
    """
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals:
            raise ConfigError(f"--set {assignment}: write it as section.key=value")
        config = _replaced(config, path.strip().split("."), text.strip(), path.strip())
    return config


def _replaced(config: C, keys: list[str], text: str, path: str) -> C:
    hints = typing.get_type_hints(type(config))
    if keys[0] not in hints:
        raise ConfigError(f"unknown setting {path}; {type(config).__name__} has {', '.join(hints)}")
    old = getattr(config, keys[0])
    if len(keys) > 1:
        if not dataclasses.is_dataclass(old):
            raise ConfigError(f"unknown setting {path}: {keys[0]} is a value, not a section")
        new = _replaced(old, keys[1:], text, path)
    elif dataclasses.is_dataclass(old):
        raise ConfigError(
            f"setting {path} is a section; name a key of it: {', '.join(typing.get_type_hints(type(old)))}"
        )
    else:
        new = _parsed(text, hints[keys[0]], path)
    try:
        return dataclasses.replace(config, **{keys[0]: new})  # type: ignore[type-var]
    except ValueError as error:
        raise ConfigError(f"setting {path}={text}: {error}") from None


def _parsed(text: str, kind: Any, path: str) -> Any:
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        kinds = [k for k in typing.get_args(kind) if k is not type(None)]
        return None if text.lower() == "none" else _parsed(text, kinds[0], path)
    try:
        if kind is bool:
            return {"true": True, "false": False}[text.lower()]
        if kind in (int, float, str):
            return kind(text)
    except (KeyError, ValueError):
        pass
    raise ConfigError(f"setting {path}={text}: the value must be of type {getattr(kind, '__name__', kind)}")
