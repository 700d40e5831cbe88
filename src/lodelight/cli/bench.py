"""`lodelight bench`."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

app = typer.Typer(add_completion=False)

# heading, where in metrics.json, factor, decimals
COLUMNS = (
    ("frames", ("frames",), 1, 0),
    ("tracked %", ("tracked_fraction",), 100, 1),
    ("mean ms", ("ms_per_frame", "mean"), 1, 1),
    ("p50", ("ms_per_frame", "p50"), 1, 1),
    ("p95", ("ms_per_frame", "p95"), 1, 1),
    ("p99", ("ms_per_frame", "p99"), 1, 1),
    ("real time", ("real_time_factor",), 1, 2),
    ("peak MB", ("peak_rss_mb",), 1, 0),
    ("ATE final cm", ("ate", "final", "rmse_m"), 100, 2),
    ("live cm", ("ate", "live", "rmse_m"), 100, 2),
)


@app.command(epilog="Example: lodelight bench recordings/room recordings/hall --sim office --runs 5")
def bench(
    recordings: list[Path] = typer.Argument(None, help="Recordings to run over; none, nor --sim: all simulated ones."),
    simulated: list[str] = typer.Option([], "--sim", help="Also over this simulated building; may be repeated."),
    duration: float = typer.Option(20.0, min=1.0, help="Length of a simulated recording, s."),
    runs: int = typer.Option(3, min=1, help="Runs of each, every one in a process of its own."),
    sensors: str = typer.Option("", help="Handed on to `lodelight run`."),
    settings: list[str] = typer.Option([], "--set", help="Handed on to `lodelight run`."),
    as_json: bool = typer.Option(False, "--json", help="Print every figure of every run."),
) -> None:
    """Time and error over recordings on this machine: medians and ranges."""
    from lodelight.cli.progress import track
    from lodelight.sim.scenarios import SCENARIOS

    options = [word for setting in settings for word in ("--set", setting)] + (
        ["--sensors", sensors] if sensors else []
    )
    with tempfile.TemporaryDirectory() as scratch:
        sources = {str(recording): recording for recording in recordings or []}
        buildings = simulated or ([] if sources else list(SCENARIOS))
        for name in track(buildings, "rendering", len(buildings)):
            sources[f"sim {name}"] = Path(scratch) / name
            _lodelight("sim", name, "--out", str(sources[f"sim {name}"]), "--duration", str(duration))
        asked = [(label, source) for label, source in sources.items() for _ in range(runs)]
        results: dict[str, list[dict[str, Any]]] = {label: [] for label in sources}
        for label, source in track(asked, "runs", len(asked)):
            printed = _lodelight("run", str(source), "--out", str(Path(scratch) / "out"), "--json", *options)
            results[label].append(json.loads(printed))
    machine = _machine()
    print(json.dumps({"machine": machine, "runs": results}, indent=2) if as_json else _page(machine, results, runs))


def _lodelight(*arguments: str) -> str:
    """What a command prints, run in a process of its own; a run that was lost throughout (status 1) prints too."""
    from lodelight.errors import SourceError

    done = subprocess.run([sys.executable, "-m", "lodelight", *arguments], capture_output=True, text=True)
    if done.returncode == 2:
        raise SourceError(done.stderr.strip().removeprefix("lodelight: ").partition("Error: ")[2] or done.stderr)
    if done.returncode not in (0, 1) or not done.stdout:  # a bug, whose traceback is worth more than a line
        raise RuntimeError(f"lodelight {' '.join(arguments)} ended with {done.returncode}\n{done.stderr}")
    return done.stdout


def _machine() -> dict[str, Any]:
    from lodelight.report.outputs import versions

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"cpu": _cpu(), "cores": os.cpu_count(), "load": load, "system": platform.platform(), **versions()}


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def _page(machine: dict[str, Any], results: dict[str, list[dict[str, Any]]], runs: int) -> str:
    """A table in Markdown: the median of the runs, and their range where they differ."""
    head = ["recording", *(name for name, *_ in COLUMNS)]
    rows = [
        [Path(name).name, *(_cell(metrics, *column[1:]) for column in COLUMNS)] for name, metrics in results.items()
    ]
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |" for row in [head, *rows]
    ]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    load = f", load {machine['load']:.1f}" if machine["load"] is not None else ""
    about = f"{machine['cpu']}, {machine['cores']} cores{load}, Python {machine['python']}, numpy {machine['numpy']}"
    return "\n".join(
        [*lines, "", f"Median of {runs} runs (lowest..highest). {about}, lodelight {machine['lodelight']}."]
    )


def _cell(metrics: Sequence[dict[str, Any]], path: tuple[str, ...], factor: float, decimals: int) -> str:
    values = []
    for entry in metrics:
        value: Any = entry
        for key in path:
            value = value[key] if value is not None else None
        if value is None:
            return "-"
        values.append(factor * value)
    low, middle, high = (f"{v:.{decimals}f}" for v in (min(values), statistics.median(values), max(values)))
    return middle if low == high else f"{middle} ({low}..{high})"
