"""`lodelight tags`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lodelight.anchors import Anchors, Tag
    from lodelight.io.recording import Recording
    from lodelight.report.paper import Page
    from lodelight.slam import SlamConfig

app = typer.Typer(
    add_completion=False, no_args_is_help=True, help="Printed tags: map where they hang, print them at true size."
)


@app.command("map", epilog="Example: lodelight tags map recordings/room --anchors sizes.toml --out out/tags")
def map_(
    source: Path = typer.Argument(..., help="Recording with depth or two cameras."),
    out: Path = typer.Option(..., help="Folder for anchors.toml, tags.png and all that `run` writes; created."),
    anchors: Path = typer.Option(None, help="anchors.toml: sizes of tags, and the places of those that are surveyed."),
    size: float = typer.Option(0.0, min=0.0, help="Side of tags of which nothing tells the size, m."),
    family: list[str] = typer.Option([], help="Look for this family as well; may be repeated."),
    sensors: str = typer.Option("", help="stereo or rgbd; default: the most the source has."),
    rig: Path = typer.Option(None, help="rig.toml, or a calibration file of another tool."),
    start: float = typer.Option(0.0, min=0.0, help="Seconds after the first frame."),
    end: float = typer.Option(float("inf"), help="Seconds after the first frame."),
    settings: list[str] = typer.Option([], "--set", help="section.key=value, as for run."),
    as_json: bool = typer.Option(False, "--json", help="Print metrics.json."),
) -> None:
    """Find where the tags of a building hang, and write the survey."""
    from lodelight.errors import RunError
    from lodelight.io.anchors_toml import read_anchors
    from lodelight.io.sources import open_source
    from lodelight.settings import with_settings
    from lodelight.slam import SlamConfig

    recording = open_source(source, rig)
    known = read_anchors(anchors) if anchors is not None else None
    families = [*family, *(["tag36h11"] if size > 0.0 and not family else [])]
    config = SlamConfig(sensors=sensors or recording.rig.sensors.removesuffix("-inertial"))
    given = [f"tags.families={' '.join(families)}", f"tags.default_size_m={size}"]
    config = with_settings(config, [*given, *settings])
    metrics = map_to_folder(recording, out, config, known, start, end)
    print(json.dumps(metrics, indent=2) if as_json else _summary(metrics, out))
    if not metrics["tags"]:
        raise RunError(f"{source}: no tag could be mapped; {out / 'events.jsonl'} says what was seen")


def map_to_folder(
    recording: Recording, out: Path, config: SlamConfig, known: Anchors | None, start_s: float, end_s: float
) -> dict[str, Any]:
    """SLAM with tags, then `tags.png`, and the errors of the survey in `metrics.json` where the recording knows it."""
    import cv2

    from lodelight.cli.run import slam_to_folder
    from lodelight.evaluation.tag_survey import compare_surveys
    from lodelight.io.anchors_toml import read_anchors
    from lodelight.io.text import write_bytes, write_text
    from lodelight.io.trajectories import read_trajectory
    from lodelight.report.plain import plain
    from lodelight.report.tag_plan import draw_tags

    metrics = slam_to_folder(recording, out, config, None, False, start_s, end_s, known)
    found = read_anchors(out / "anchors.toml").tags
    if found:
        picture = draw_tags(found, read_trajectory(out / "trajectory.tum"), metrics["aligned"])
        write_bytes(out / "tags.png", cv2.imencode(".png", picture)[1].tobytes())
    truth = recording.path / "anchors.toml"
    if truth.is_file():
        metrics["tag_errors"] = plain(compare_surveys(found, read_anchors(truth).tags, not metrics["aligned"]))
        write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    return metrics


def _summary(m: dict[str, Any], out: Path) -> str:
    frame = "in the world of the surveyed ones" if m["aligned"] else "in the frame of the first image"
    lines = [f"{m['tags']} tags mapped {frame}, from {m['frames']} frames"]
    if e := m.get("tag_errors"):
        fit = "after alignment" if e["aligned"] else "without alignment"
        lines.append(
            f"errors of {e['count']} {fit}: rmse {e['rmse_m']:.4f} m, median {e['median_m']:.4f}, "
            f"most {e['max_m']:.4f} ({e['worst']}), {e['rotation_deg']:.2f} deg"
        )
    return "\n".join([*lines, f"survey: {out / 'anchors.toml'}"])


@app.command("print", epilog="Example: lodelight tags print --family tag36h11 --ids 0-11 --size 0.15 --out tags.pdf")
def print_(
    anchors: Path = typer.Argument(None, help="anchors.toml whose [[tag]] entries are printed."),
    out: Path = typer.Option(..., help=".pdf, or .svg (one file a page)."),
    family: str = typer.Option("qr", help="Of --ids: qr, tag36h11, aruco_4x4_50, ..."),
    ids: str = typer.Option("", help="Names or numbers, 0-11,20 or A1,A2."),
    size: float = typer.Option(0.15, help="Of --ids: side of the code without its white border, m."),
    page: str = typer.Option("a4", help="a5 to a0, letter, or 300x400 in mm."),
    place: bool = typer.Option(True, help="QR codes carry where they hang, if the anchors know it."),
    board: str = typer.Option("", help="Print a calibration board instead: default, or tag36h11:6x8:24/7.2mm."),
) -> None:
    """Printable sheets at true size, with cut marks and a ruler to check the printer by."""
    from lodelight.errors import ConfigError
    from lodelight.io.anchors_toml import read_anchors
    from lodelight.report.sheets import board_sheet, page_size_mm, sheets
    from lodelight.tagboard import TagBoard

    page_mm = page_size_mm(page)
    if board:
        pages = [board_sheet(TagBoard() if board == "default" else TagBoard.parse(board), page_mm)]
    else:
        if bool(ids) == (anchors is not None):
            raise ConfigError("give either an anchors.toml or --ids, to say which tags to print")
        tags = read_anchors(anchors).tags if anchors is not None else _named(family, ids, size)
        pages = sheets(tags, page_mm, place)
    written = _write(out, pages)
    print(f"{len(pages)} pages in {', '.join(map(str, written[:3]))}{' ...' if len(written) > 3 else ''}")


def _named(family: str, ids: str, size_m: float) -> tuple[Tag, ...]:
    """Tags of `0-11,20` or `A1,A2`."""
    from lodelight.anchors import Tag
    from lodelight.errors import ConfigError

    if not 0.005 <= size_m <= 5.0:
        raise ConfigError(f"--size must lie between 0.005 and 5 m, got {size_m:g}")
    names: list[str] = []
    for part in filter(None, (p.strip() for p in ids.split(","))):
        first, dash, last = part.partition("-")
        if dash and first.isdecimal() and last.isdecimal() and family != "qr":
            if not int(first) <= int(last) < int(first) + 2000:
                raise ConfigError(f"--ids {part}: write it as first-last, 2000 at most")
            names += [str(i) for i in range(int(first), int(last) + 1)]
        else:
            names.append(part)
    return tuple(Tag(family, name, size_m) for name in names)


def _write(out: Path, pages: Sequence[Page]) -> list[Path]:
    from lodelight.errors import ConfigError
    from lodelight.io.text import write_bytes, write_text
    from lodelight.report.paper import to_pdf, to_svg

    if out.suffix == ".pdf":
        write_bytes(out, to_pdf(pages))
        return [out]
    if out.suffix != ".svg":
        raise ConfigError(f"--out {out}: end it in .pdf or .svg")
    files = [out] if len(pages) == 1 else [out.with_stem(f"{out.stem}-{i:03d}") for i in range(1, len(pages) + 1)]
    for file, page in zip(files, pages, strict=True):
        write_text(file, to_svg(page))
    return files
