"""`lodelight map info|check|export|merge`."""

from __future__ import annotations

import json
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from lodelight.mapping.merge import Merged, Part
    from lodelight.types import Array

app = typer.Typer(add_completion=False, help="Inspect, check, export and merge saved maps.")

MAP = typer.Argument(..., metavar="MAP", help="Map file (map.lode) or the out folder of a run.")
JSON = typer.Option(False, "--json", help="Print JSON.")


class Format(str, Enum):
    """What a map can become."""

    ply = "ply"
    pcd = "pcd"
    colmap = "colmap"
    grid = "grid"


@app.command(epilog="Example: lodelight map info out/map.lode --json")
def info(map_path: Path = MAP, as_json: bool = JSON) -> None:
    """What is in a map: counts, extents, sensors, versions; read at once, however large it is."""
    from lodelight.mapping.store import map_info

    found = map_info(_file(map_path))
    print(json.dumps(found, indent=2) if as_json else _told(found))


@app.command(epilog="Example: lodelight map check out/map.lode")
def check(map_path: Path = MAP, as_json: bool = JSON) -> None:
    """Read all of a map and test everything that must hold in it; exit status 1 where something does not."""
    from lodelight.mapping.store import check_map

    problems = check_map(_file(map_path))
    if as_json:
        print(json.dumps({"path": str(_file(map_path)), "problems": problems}, indent=2))
    else:
        print("\n".join(problems) or f"{_file(map_path)} is sound")
    if problems:
        raise typer.Exit(1)


@app.command(
    epilog="Example: lodelight map export out/map.lode --format grid --out kitchen.yaml --resolution 0.1 --up z"
)
def export(
    map_path: Path = MAP,
    format: Format = typer.Option(..., help="ply, pcd: points. colmap: text model. grid: PGM and YAML for ROS."),
    out: Path = typer.Option(..., help="File to write; for colmap a folder."),
    up: str = typer.Option("auto", help="grid: up in the map's frame, as z, -y or three numbers 0,0.1,1."),
    resolution: float = typer.Option(0.05, min=0.001, help="grid: width of a cell, m."),
    band: tuple[float, float] = typer.Option((0.1, 1.8), help="grid: heights above the floor that count, m."),
    floor: float = typer.Option(None, help="grid: height of the floor along up, m; else of the lowest points."),
    reach: float = typer.Option(
        10.0, "--range", min=0.1, help="grid: points farther from their camera are left out, m."
    ),
    as_json: bool = JSON,
) -> None:
    """Write a map as a point cloud, a COLMAP text model, or an occupancy grid."""
    from lodelight.mapping import export as to
    from lodelight.mapping.store import load_map

    map = load_map(_file(map_path))
    if format is Format.colmap:
        told = to.export_colmap(map, out)
    elif format is Format.grid:
        told = to.export_grid(
            map, out, _direction(up), resolution_m=resolution, band_m=band, floor_m=floor, range_m=reach
        )
    else:
        told = to.export_cloud(map, out, format.value)
    print(json.dumps(told, indent=2) if as_json else "\n".join(f"{key:<12} {value}" for key, value in told.items()))


@app.command(epilog="Example: lodelight map merge out/monday out/tuesday --out building.lode")
def merge(
    maps: list[Path] = typer.Argument(..., metavar="MAP...", help="Map files or out folders; only read."),
    out: Path = typer.Option(..., help="Map file to write."),
    as_json: bool = JSON,
) -> None:
    """Make one map of several of one building, by tags and places that they share, and adjust it as a whole."""
    from lodelight.errors import RunError
    from lodelight.mapping.merge import merged
    from lodelight.mapping.store import load_map, save_map

    files = [_file(path) for path in maps]
    _check_merge(files, out)
    together = merged([load_map(path) for path in files], on_part=lambda i, part: _progress(files[i], part))
    left_out = [(path, part.why) for path, part in zip(files, together.parts, strict=True) if not part.by]
    if len(left_out) < len(files) - 1:
        save_map(together.map, out, {"merged": ", ".join(sorted(str(p) for p in files if p not in dict(left_out)))})
        told = _merged(files, together) | {"out": str(out)}
        print(json.dumps(told, indent=2) if as_json else _merged_text(told))
    if left_out:
        kept = f"the others are in {out}" if len(left_out) < len(files) - 1 else "nothing was written"
        raise RunError("; ".join(f"{path} was left out: {why}" for path, why in left_out) + f"; {kept}")


def _check_merge(files: list[Path], out: Path) -> None:
    from lodelight.errors import MapError

    if len(files) < 2:
        raise typer.BadParameter("name at least two maps.")
    resolved = [path.resolve() for path in files]
    if len(set(resolved)) < len(files):
        raise typer.BadParameter("a map is named twice.")
    if out.resolve() in resolved:
        raise MapError(f"--out {out} is one of the maps; merging never changes those, choose another name")


def _progress(path: Path, part: Part) -> None:
    import sys

    if sys.stderr.isatty():
        print(f"{path}: {f'joined by {part.by}' if part.by else f'left out, {part.why}'}", file=sys.stderr)


def _merged(files: list[Path], together: Merged) -> dict[str, Any]:
    parts = [
        {
            "map": str(path), "by": part.by, "why": part.why, "keyframes": part.keyframes[1] - part.keyframes[0],
            "pairs": part.pairs, "tags": list(part.tags), "shared_points": together.shared_points(i),
        }
        for i, (path, part) in enumerate(zip(files, together.parts, strict=True))
    ]  # fmt: skip
    return {
        "parts": parts, "keyframes": len(together.map.keyframes), "points": len(together.map.points),
        "loops": len(together.map.loops), "tags": int(together.map.tags.placed.sum()),
    }  # fmt: skip


def _merged_text(told: dict[str, Any]) -> str:
    lines = []
    for part in told["parts"]:
        how = {"base": "the base", "": f"left out: {part['why']}"}.get(part["by"], f"by {part['by']}")
        agree = f" ({part['pairs']} places, {len(part['tags'])} tags agree)" if part["by"] not in ("", "base") else ""
        count = f", {part['keyframes']} keyframes, {part['shared_points']} points shared" if part["by"] else ""
        lines.append(f"{part['map']}: {how}{agree}{count}")
    return "\n".join(
        [*lines, f"{told['out']}: {told['keyframes']} keyframes, {told['points']} points, {told['tags']} tags"]
    )


def _file(path: Path) -> Path:
    return path / "map.lode" if (path / "map.lode").is_file() else path


def _direction(text: str) -> Array | None:
    """Up as a unit vector; None for auto."""
    import numpy as np

    axes = dict(zip(("x", "y", "z", "-x", "-y", "-z"), np.vstack([np.eye(3), -np.eye(3)]), strict=True))
    if text == "auto":
        return None
    try:
        vector = axes[text] if text in axes else np.array([float(part) for part in text.split(",")])
    except ValueError:
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not 0.0 < length < np.inf:
        raise typer.BadParameter(f"--up {text} is no direction; write auto, z, -y or three numbers such as 0,0.1,1")
    return vector / length


def _told(found: dict[str, Any]) -> str:
    duration_s = (found["last_t_ns"] - found["first_t_ns"]) / 1e9 if found["keyframes"] else 0.0
    path = f"{duration_s:.1f} s and {found['path_m']:.1f} m"
    low, high = found["bounds_m"] or ([0.0] * 3, [0.0] * 3)
    size = " x ".join(f"{b - a:.1f}" for a, b in zip(low, high, strict=True))
    megabytes = f"{found['bytes'] / 1e6:.1f} MB"
    lines = {
        "map": f"{found['path']}, {megabytes}, format {found['format']}, saved by lodelight {found['lodelight']}",
        "keyframes": f"{found['keyframes']} over {path}, {found['loops']} loops",
        "points": f"{found['points']} in {size} m, seen {found['observations']} times in {found['features']} features",
        "sensors": f"{found['sensors']}: {', '.join(found['cameras'])}",
    }
    if found["notes"]:
        lines["notes"] = ", ".join(f"{key} {value}" for key, value in found["notes"].items())
    return "\n".join(f"{key:<10} {value}" for key, value in lines.items())
