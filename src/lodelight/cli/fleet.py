"""`lodelight fleet`."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from lodelight.fleet.jobs import Job, Outcome

app = typer.Typer(add_completion=False)


@app.command(epilog="Example: lodelight fleet recordings/* --out building --anchors anchors.toml")
def fleet(
    recordings: list[Path] = typer.Argument(..., metavar="RECORDINGS...", help="Recordings of one building."),
    out: Path = typer.Option(..., help="Folder for a run of each, the map of all, summary and report; goes on there."),
    scheduler: str = typer.Option("", help="Address of a dask scheduler, as tcp://host:8786; default: this machine."),
    jobs: int = typer.Option(0, min=0, help="Runs at a time on this machine; default: one for each processor."),
    sensors: str = typer.Option("", help="As of `lodelight run`; default: the most each recording has."),
    rig: Path = typer.Option(None, help="rig.toml for all of them."),
    anchors: Path = typer.Option(None, help="anchors.toml: what is surveyed of the building."),
    seed: int = typer.Option(0, help="Seed of every random draw."),
    settings: list[str] = typer.Option([], "--set", help="section.key=value, as of `lodelight run`."),
    as_json: bool = typer.Option(False, "--json", help="Print summary.json."),
) -> None:
    """SLAM over many recordings of one building, here or on a cluster, and one map of them all."""
    from lodelight.errors import RunError
    from lodelight.fleet import jobs as work
    from lodelight.fleet.building import drawn, merge_runs, summary_of
    from lodelight.fleet.workers import in_processes, on_cluster
    from lodelight.io.text import write_text
    from lodelight.report.fleet import write_fleet_report
    from lodelight.settings import with_settings
    from lodelight.slam import SlamConfig

    with_settings(SlamConfig(), settings)  # wrong ones are told now, not once for each recording
    options = {
        "sensors": sensors, "seed": seed, "settings": settings,
        "rig": os.path.abspath(rig) if rig else None, "anchors": os.path.abspath(anchors) if anchors else None,
    }  # fmt: skip
    asked = work.jobs_of(recordings, out, options)
    _sweep(out)
    (out / "runs").mkdir(parents=True, exist_ok=True)
    outcomes = {job.name: before for job in asked if (before := work.kept(job)) is not None}
    missing = [job for job in asked if job.name not in outcomes]
    if missing:
        count = min(jobs or os.cpu_count() or 1, len(missing))
        stream = on_cluster(missing, run_one, scheduler) if scheduler else in_processes(
            missing, run_one, count
        )  # fmt: skip
        for outcome in _shown(stream, len(asked), len(outcomes)):
            outcomes[outcome.name] = outcome
        _sweep(out)
    parts = merge_runs(asked, outcomes, out)
    told = summary_of(asked, outcomes, parts, out)
    write_text(out / "summary.json", json.dumps(told, indent=2) + "\n")
    write_fleet_report(out, told, *drawn(parts, out))
    print(json.dumps(told, indent=2) if as_json else table(told, out))
    if wrong := [_complaint(row) for row in told["recordings"] if _complaint(row)]:
        raise RunError("; ".join(wrong))


def run_one(job: Job) -> Outcome:
    """A recording from end to end, in whichever process; what goes wrong with it is an outcome like any other."""
    import contextlib
    import io
    import socket
    import traceback

    from threadpoolctl import threadpool_limits

    from lodelight.errors import LodelightError
    from lodelight.fleet.jobs import KEPT, Outcome, as_asked

    final = Path(job.out)
    attempt = final.with_name(f".{final.name}.{socket.gethostname()}.{os.getpid()}")
    try:
        _remove(attempt)
        with threadpool_limits(1), contextlib.redirect_stderr(io.StringIO()):  # its own progress is nobody's
            metrics = _run(job, attempt)
        (attempt / KEPT).write_text(json.dumps(as_asked(job), indent=2) + "\n", encoding="utf-8")
        _remove(final)
        attempt.rename(final)
    except LodelightError as error:
        return Outcome(job.name, "failed", str(error))
    except OSError as error:
        return Outcome(job.name, "failed", f"{error.filename or job.out}: {error.strerror or error}")
    except Exception as error:
        log = final.with_name(f"{final.name}.error.txt")
        log.write_text(traceback.format_exc(), encoding="utf-8")
        return Outcome(job.name, "failed", f"a bug, please report it: {type(error).__name__}: {error}; see {log}")
    finally:
        _remove(attempt)
    lost = metrics["tracked_fraction"] == 0.0
    return Outcome(job.name, "lost" if lost else "done", "no frame could be localized" if lost else "", metrics)


def _run(job: Job, out: Path) -> dict[str, Any]:
    from lodelight.cli.run import prepared, slam_to_folder

    o = job.options
    recording, config, anchors = prepared(job.source, o["rig"], o["anchors"], o["sensors"], o["seed"], o["settings"])
    return slam_to_folder(recording, out, config, anchors=anchors)


def _shown(outcomes: Iterable[Outcome], total: int, before: int) -> Iterator[Outcome]:
    """The same outcomes, with a bar and a line for each on standard error while that is a terminal."""
    import sys

    if not sys.stderr.isatty():
        yield from outcomes
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("recordings"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("recordings", total=total, completed=before)
        for outcome in outcomes:
            progress.console.print(f"{outcome.name}: {outcome.state}{f', {outcome.why}' if outcome.why else ''}")
            progress.advance(task)
            yield outcome


def table(told: dict[str, Any], out: Path) -> str:
    """One line for each recording, and one for the map."""
    head = ["recording", "state", "frames", "tracked", "keyframes", "ATE cm", "in the map"]
    rows = [head]
    for row in told["recordings"]:
        m, part = row["metrics"], row["in_map"]
        cells = [row["name"], row["state"]]
        if m is None:
            rows.append([*cells, "-", "-", "-", "-", row["why"]])
            continue
        ate = f"{100 * m['ate']['final']['rmse_m']:.1f}" if m["ate"] and m["ate"]["final"] else "-"
        rows.append([
            *cells, str(m["frames"]), f"{100 * m['tracked_fraction']:.0f} %", str(m["keyframes"]), ate, _in_map(part)
        ])  # fmt: skip
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    if told["map"]:
        m = told["map"]
        lines.append(f"map: {m['keyframes']} keyframes, {m['points']} points, {m['tags']} tags: {out / 'map.lode'}")
    return "\n".join([*lines, f"report: {out / 'report.html'}"])


def _in_map(part: dict[str, Any] | None) -> str:
    if part is None:
        return "no"
    if part["by"] in ("", "base"):
        return "the base" if part["by"] else f"no: {part['why']}"
    return f"by {part['by']} ({part['pairs']} places, {len(part['tags'])} tags)"


def _complaint(row: dict[str, Any]) -> str:
    if row["state"] in ("failed", "lost"):
        return f"{row['name']} {row['state']}: {row['why']}"
    left_out = row["in_map"] is not None and not row["in_map"]["by"]
    return f"{row['name']} is not in the map: {row['in_map']['why']}" if left_out else ""


def _sweep(out: Path) -> None:
    """Remove what runs left that were killed."""
    for leftover in (out / "runs").glob(".*"):
        _remove(leftover)


def _remove(path: Path) -> None:
    import shutil

    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
