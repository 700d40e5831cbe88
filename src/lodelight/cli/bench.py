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


@app.command(epilog="Example: lodelight bench recordings/room recordings/hall --runs 5")
def bench(
    recordings: list[Path] = typer.Argument(..., help="Recordings to run over."),
    runs: int = typer.Option(3, min=1, help="Runs of each, every one in a process of its own."),
    settings: list[str] = typer.Option([], "--set", help="Handed on to `lodelight run`."),
    as_json: bool = typer.Option(False, "--json", help="Print every figure of every run."),
) -> None:
    """Time and error over recordings on this machine: medians and ranges."""
    from lodelight.cli.progress import track

    with tempfile.TemporaryDirectory() as scratch:
        asked = [(recording, Path(scratch) / "out") for recording in recordings for _ in range(runs)]
        done = [(str(rec), _run(rec, out, settings)) for rec, out in track(asked, "runs", len(asked))]
    results = {str(rec): [metrics for name, metrics in done if name == str(rec)] for rec in recordings}
    machine = _machine()
    print(json.dumps({"machine": machine, "runs": results}, indent=2) if as_json else _page(machine, results, runs))


def _run(recording: Path, out: Path, settings: list[str]) -> dict[str, Any]:
    """metrics.json of one run; a recording that was lost throughout has one too."""
    from lodelight.errors import SourceError

    chosen = [word for setting in settings for word in ("--set", setting)]
    command = [sys.executable, "-m", "lodelight", "run", str(recording), "--out", str(out), "--json", *chosen]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 2:
        raise SourceError(done.stderr.strip().removeprefix("lodelight: ").removeprefix("SourceError: "))
    if not done.stdout:  # a bug, whose traceback is worth more than a line
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}\n{done.stderr}")
    metrics: dict[str, Any] = json.loads(done.stdout)
    return metrics


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
