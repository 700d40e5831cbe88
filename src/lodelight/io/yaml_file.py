"""YAML files as calibration tools write them, OpenCV's dialect included."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from lodelight.errors import CalibrationError
from lodelight.io.schema import Section
from lodelight.io.text import read_text


class _Loader(yaml.SafeLoader):
    """Takes `1e-5` for the number it is, `.Nan` for not a number, and OpenCV's matrices for tables."""


_Loader.yaml_implicit_resolvers = {k: list(v) for k, v in yaml.SafeLoader.yaml_implicit_resolvers.items()}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+|[-+]?\.(inf|Inf|INF)|\.(nan|Nan|NaN|NAN)"),
    list("-+0123456789."),
)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    assert isinstance(node, yaml.MappingNode)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def read_yaml(path: Path) -> Section:
    """The file's one table. Raises CalibrationError where it is not YAML or not a table."""
    # OpenCV writes `%YAML:1.0`, which no YAML reader takes for the directive it means
    text = re.sub(r"\A\s*%YAML[^\n]*\n(---)?", "", read_text(path))
    try:
        data = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: what looked like a number or a date is none
        line = (
            f" line {error.problem_mark.line + 1}"
            if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark
            else ""
        )
        raise CalibrationError(f"{path}{line} is not valid YAML") from None
    return Section(data, f"{path}:")
