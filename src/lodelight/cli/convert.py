"""`lodelight convert`."""

from __future__ import annotations

import sys
from pathlib import Path

import typer

from lodelight.cli.options import TOPIC_HELP

app = typer.Typer(add_completion=False)


@app.command(epilog="Example: lodelight convert recordings/kitchen kitchen_euroc --end 10")
def convert(
    source: Path = typer.Argument(..., help="A recording, trajectory or calibration this package reads."),
    dest: Path = typer.Argument(
        ..., help="*.tum, *.csv, *.kitti: trajectory; *.toml: rig; *.bag, *.mcap, *.db3: ROS bag; else an EuRoC folder."
    ),
    rig: Path | None = typer.Option(None, "--rig", help="Rig file, where the recording does not say or is wrong."),
    start: float = typer.Option(0.0, min=0.0, help="Seconds from the first frame to begin at."),
    end: float = typer.Option(float("inf"), min=0.0, help="Seconds from the first frame to stop at."),
    topic: list[str] = typer.Option([], "--topic", help=TOPIC_HELP),
) -> None:
    """Turn any readable recording, trajectory or rig into a writable one."""
    from lodelight.cli.progress import track
    from lodelight.io.convert import convert as write
    from lodelight.io.recording import summarize
    from lodelight.io.rosbag_topics import parse_roles

    recording = write(source, dest, rig, start, end, lambda frames, n: track(frames, "writing", n), parse_roles(topic))
    if recording is not None and recording.skipped:
        print(summarize(recording.skipped), file=sys.stderr)
