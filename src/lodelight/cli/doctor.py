"""`lodelight doctor`."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from lodelight.cli.options import TOPIC_HELP

app = typer.Typer(add_completion=False)
MARK = {"ok": "ok   ", "note": "note ", "fault": "FAULT"}


@app.command(epilog="Example: lodelight doctor recordings/room --rig my_rig.toml")
def doctor(
    source: Path = typer.Argument(..., help="A recording of any known format."),
    rig: Path = typer.Option(None, help="rig.toml, or a calibration file of another tool, to check instead."),
    topic: list[str] = typer.Option([], "--topic", help=TOPIC_HELP),
    as_json: bool = typer.Option(False, "--json", help="Print the findings as JSON."),
) -> None:
    """Check a recording and its calibration: what is wrong, and by how much. Status 1 if it would spoil a run."""
    from lodelight.cli.progress import track
    from lodelight.doctor.examine import judge, look
    from lodelight.doctor.gather import BUDGET_FRAMES, Seen
    from lodelight.errors import RunError, SourceError
    from lodelight.io.rosbag_topics import parse_roles
    from lodelight.io.sources import open_source

    recording = open_source(source, rig, parse_roles(topic))
    if recording.is_live:
        raise SourceError(f"{recording.name} is a camera; record it, or check a recording of it")
    seen = Seen()
    for seen, _ in track(look(recording), "looking", BUDGET_FRAMES):  # noqa: B007
        pass
    findings = judge(seen, recording.rig, recording)
    if as_json:
        print(json.dumps({"source": str(source), "findings": [f.row() for f in findings]}, indent=2))
    else:
        width = max(len(f.name) for f in findings)
        print("\n".join(f"{MARK[f.level]} {f.name:{width}}  {f.text}" for f in findings))
    faults = [f.name for f in findings if f.level == "fault"]
    if faults:
        raise RunError(f"{source}: {', '.join(faults)} would spoil a run")
