"""The runs of a fleet as one map, and what is said of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.errors import LodelightError, MapError, RunError
from lodelight.fleet.jobs import Job, Outcome
from lodelight.io.text import write_text
from lodelight.mapping.merge import Merged, merged
from lodelight.mapping.store import load_map, map_info, save_map
from lodelight.types import Array


def merge_runs(jobs: Sequence[Job], outcomes: dict[str, Outcome], out: Path) -> list[dict[str, Any]] | None:
    """Merge the maps of the runs that have one into `out/map.lode`; what became of each, in the order of the jobs.

    None where there is no map. A merged map of just these maps is kept as it is.
    """
    mapped = [job for job in jobs if outcomes[job.name].state in ("done", "kept")]
    if not mapped:
        return None
    digest = hashlib.sha256("".join(_digest(Path(job.out) / "map.lode") for job in mapped).encode()).hexdigest()
    before = _kept_merge(out, digest)
    if before is not None:
        return before
    try:
        together = merged([load_map(Path(job.out) / "map.lode") for job in mapped])
    except LodelightError as error:
        raise RunError(f"the maps could not be merged: {error}; the runs are kept in {out / 'runs'}") from None
    parts = _told(mapped, together)
    save_map(together.map, out / "map.lode", {"maps": len(mapped), "inputs": digest})
    write_text(out / "merge.json", json.dumps({"inputs": digest, "parts": parts}, indent=2) + "\n")
    return parts


def _kept_merge(out: Path, digest: str) -> list[dict[str, Any]] | None:
    try:
        told = json.loads((out / "merge.json").read_text(encoding="utf-8"))
        same = told["inputs"] == digest == map_info(out / "map.lode")["notes"].get("inputs")
        parts: list[dict[str, Any]] = told["parts"]
    except (OSError, ValueError, KeyError, MapError):
        return None
    return parts if same else None


def _told(jobs: Sequence[Job], together: Merged) -> list[dict[str, Any]]:
    return [
        {
            "name": job.name, "by": part.by, "why": part.why, "pairs": part.pairs, "tags": list(part.tags),
            "rows": list(part.keyframes), "shared_points": together.shared_points(i) if part.by else 0,
            "T_map_own": None if part.T_merged_own is None else
            {"xyz": part.T_merged_own.t.tolist(), "quat_xyzw": part.T_merged_own.quat_xyzw.tolist()},
        }
        for i, (job, part) in enumerate(zip(jobs, together.parts, strict=True))
    ]  # fmt: skip


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def summary_of(
    jobs: Sequence[Job], outcomes: dict[str, Outcome], parts: list[dict[str, Any]] | None, out: Path
) -> dict[str, Any]:
    """What `summary.json` holds."""
    in_map = {part["name"]: part for part in parts or []}
    rows = []
    for job in jobs:
        outcome = outcomes[job.name]
        row = {"source": job.source, "out": job.out, **asdict(outcome)}
        part = in_map.get(job.name)
        rows.append(row | {"in_map": part})
    told: dict[str, Any] = {"recordings": rows, "map": None}
    if parts is not None:
        about = map_info(out / "map.lode")
        told["map"] = {name: about[name] for name in ("path", "keyframes", "points", "tags", "loops", "bounds_m")}
    return told


def drawn(parts: list[dict[str, Any]] | None, out: Path) -> tuple[dict[str, Array], Array]:
    """Keyframes (K, 3) m of every recording in the map in the order of their stamps, and the map's points (N, 3) m."""
    if parts is None:
        return {}, np.zeros((0, 3))
    map = load_map(out / "map.lode")
    paths = {}
    for part in parts:
        if part["by"]:
            rows = np.arange(*part["rows"])
            paths[part["name"]] = map.keyframes.p[rows[np.argsort(map.keyframes.t_ns[rows], kind="stable")]]
    return paths, map.points.xyz[map.alive_points]
