"""Imports point down: a module sees its own layer and the layers below it (docs/architecture.md)."""

import ast
from pathlib import Path

SRC = Path(__file__).parents[1] / "src"

# Highest first. What stands in one row is one layer, whose members do not see each other.
LAYERS = [
    ["__main__"],
    ["cli", "ros"],
    ["slam", "localizer", "doctor", "fleet"],
    ["inertial"],
    ["localization"],
    ["mapping", "odometry"],
    ["estimation"],
    ["features", "tags", "lights", "imu"],
    ["report"],
    ["sim", "evaluation"],
    ["io"],
    ["rig", "anchors", "trajectory", "settings", "tagboard"],
    ["messages"],
    ["geometry"],
    ["fiducials"],
    ["compiled", "memory", "types", "errors", "data"],
    ["freshness"],
]
# Below the estimators in the list, yet not for them: they may not import these.
OUTSIDE = {"io", "sim", "evaluation", "report"}
ALLOWED = {("mapping", "io")}  # save that a map file holds its rig as the text of a rig.toml
ESTIMATORS = {"inertial", "localization", "mapping", "odometry", "estimation", "features", "tags", "lights", "imu"}
RANK = {name: len(LAYERS) - row for row, names in enumerate(LAYERS) for name in names}


def imports_of(source: str) -> set[str]:
    """First-level parts of lodelight that a module imports, wherever in the file it does."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide their layer"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = {name.split(".")[1] for name in found if name.startswith("lodelight.")} - {"__version__"}
    assert parts <= RANK.keys(), f"{parts - RANK.keys()}: no layer; import from the module that defines it"
    return parts


def upward(part: str, source: str) -> set[str]:
    """Imports that a module of `part` must not have."""
    others = imports_of(source) - {part}
    apart = {o for o in others if part in ESTIMATORS and o in OUTSIDE and (part, o) not in ALLOWED}
    return apart | {o for o in others if RANK[o] >= RANK[part]}


def test_imports_point_down():
    wrong = {}
    for file in sorted((SRC / "lodelight").rglob("*.py")):
        part = file.relative_to(SRC / "lodelight").parts[0].removesuffix(".py")
        if part != "__init__" and (bad := upward(part, file.read_text(encoding="utf-8"))):
            wrong[str(file.relative_to(SRC))] = sorted(bad)
    assert wrong == {}


def test_an_import_that_points_up_is_found():
    assert upward("geometry", "from lodelight.mapping.map import Map") == {"mapping"}
    assert upward("imu", "def f():\n    import lodelight.features.klt") == {"features"}
    assert upward("estimation", "from lodelight.io.text import rows") == {"io"}
    assert upward("cli", "from lodelight import slam") == set()
