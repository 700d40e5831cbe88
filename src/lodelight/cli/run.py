"""`lodelight run`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from lodelight.cli.options import RRD_HELP, TOPIC_HELP, VIEW_HELP, WEB_HELP

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from lodelight.anchors import Anchors
    from lodelight.cli.watching import Watcher
    from lodelight.evaluation.align import Mode
    from lodelight.io.recording import Recording
    from lodelight.mapping.map import Map
    from lodelight.messages import LightFix
    from lodelight.slam import SlamConfig

app = typer.Typer(add_completion=False)


@app.command(epilog="Example: lodelight run recordings/room --out out/room --sensors rgbd")
def run(
    source: Path = typer.Argument(..., help="A recording of any known format, or the number of a camera."),
    out: Path = typer.Option(..., help="Folder for trajectory, map, report; created."),
    sensors: str = typer.Option(
        "", help="mono, stereo, rgbd, or one of them with -inertial; default: the most the source has."
    ),
    rig: Path = typer.Option(None, help="rig.toml, or a calibration file of another tool."),
    anchors: Path = typer.Option(None, help="anchors.toml: what is surveyed of the building."),
    gate: str = typer.Option("none", help="lights: keyframes must agree with the pose by coded lights; or none."),
    lights: str = typer.Option("off", help="tight: coded lights are part of every adjustment; or off."),
    light_odometry: str = typer.Option("", help="Poses by lights made elsewhere, for --gate: FILE or BAG:TOPIC."),
    light_frame: str = typer.Option("", help="Whose poses those are: body, or the light camera's name."),
    map_file: Path = typer.Option(None, "--map", help="Continue this saved map."),
    live: bool = typer.Option(False, "--live", help="Pace by the stamps, mapping on its own thread."),
    start: float = typer.Option(0.0, min=0.0, help="Seconds after the first frame."),
    end: float = typer.Option(float("inf"), help="Seconds after the first frame."),
    seed: int = typer.Option(0, help="Seed of every random draw."),
    settings: list[str] = typer.Option([], "--set", help="section.key=value, for example mapping.window=30."),
    topic: list[str] = typer.Option([], "--topic", help=TOPIC_HELP),
    view: bool = typer.Option(False, "--view", help=VIEW_HELP),
    web: bool = typer.Option(False, "--web", help=WEB_HELP),
    rrd: Path = typer.Option(None, "--rrd", help=RRD_HELP),
    as_json: bool = typer.Option(False, "--json", help="Print metrics.json."),
) -> None:
    """SLAM over a recording: trajectory, map and report."""
    from lodelight.cli.watching import ViewOptions
    from lodelight.errors import ConfigError, RunError
    from lodelight.io.rosbag_topics import parse_roles
    from lodelight.io.sources import open_source
    from lodelight.mapping.store import load_map

    asked = [f"gate.use={gate}", f"lights.use={lights}", *settings]
    recording, config, surveyed = prepared(source, rig, anchors, sensors, seed, asked, topic)
    known = load_map(map_file) if map_file else None
    fixes: Iterable[LightFix] = ()
    if config.gate.use != "none" or config.lights.use != "off":
        again = open_source(source, rig, parse_roles(topic))
        fixes = light_fixes(recording, again, surveyed, light_odometry, light_frame, start, end)
    elif light_odometry:
        raise ConfigError("--light-odometry is used by the gate; add --gate lights")
    watcher = ViewOptions(view, web, rrd).watcher(recording, surveyed)
    metrics = slam_to_folder(recording, out, config, known, live, start, end, surveyed, fixes, watcher)
    print(json.dumps(metrics, indent=2) if as_json else _summary(metrics, out), flush=True)
    if watcher:
        watcher.stay()
    if metrics["tracked_fraction"] == 0.0:
        raise RunError(f"{source}: no frame could be localized; {out / 'events.jsonl'} says why")


def prepared(
    source: Path | str, rig: Path | None, anchors: Path | None, sensors: str, seed: int, settings: list[str],
    topics: Sequence[str] = (),
) -> tuple[Recording, SlamConfig, Anchors | None]:  # fmt: skip
    """A recording, what is in force, and what is surveyed; sensors : empty = the most that the recording has."""
    from lodelight.io.anchors_toml import read_anchors
    from lodelight.io.rosbag_topics import parse_roles
    from lodelight.io.sources import open_source
    from lodelight.settings import with_settings
    from lodelight.slam import SlamConfig

    recording = open_source(source, rig, parse_roles(list(topics)))
    config = with_settings(SlamConfig(sensors=sensors or recording.rig.sensors, seed=seed), settings)
    return recording, config, read_anchors(anchors) if anchors else None


def light_fixes(
    recording: Recording, again: Recording, anchors: Anchors | None, odometry: str, frame: str, start_s: float,
    end_s: float,
) -> Iterable[LightFix]:  # fmt: skip
    """What the lights say, from an odometry file or from the light camera of the recording, opened a second time."""
    from lodelight.cli.lights import light_frames
    from lodelight.errors import ConfigError
    from lodelight.io.light_odometry import check_clock, read_light_odometry

    if odometry:
        fixes = read_light_odometry(odometry, recording.rig, frame)
        check_clock(fixes, recording.span_ns, odometry)
        return fixes
    if anchors is None:
        raise ConfigError("lights mean nothing without their places; give --anchors FILE, or --light-odometry FILE")
    level = "imu" if recording.rig.imu is not None else "mounting"
    return (read.fix for read in light_frames(again, anchors, level, start_s=start_s, end_s=end_s))


def slam_to_folder(
    recording: Recording,
    out: Path,
    config: SlamConfig,
    known: Map | None = None,
    live: bool = False,
    start_s: float = 0.0,
    end_s: float = float("inf"),
    anchors: Anchors | None = None,
    fixes: Iterable[LightFix] = (),
    watcher: Watcher | None = None,
) -> dict[str, Any]:
    """Run SLAM over a recording and write the out folder; returns what `metrics.json` holds.

    known : a loaded map to continue; live : paced by the stamps
    fixes : what lights say, by rising stamp; the config says what is made of it
    watcher : shows it while it goes on
    """
    import cv2

    from lodelight.cli.live import stopped_by_interrupt
    from lodelight.cli.progress import track
    from lodelight.compiled import compile_seconds
    from lodelight.mapping.store import save_map
    from lodelight.report.outputs import Outputs
    from lodelight.settings import as_table
    from lodelight.slam import Slam

    cv2.setNumThreads(1)  # whole stages run on two threads; image operations that split further only get in the way
    live = live or recording.is_live
    asked = {"source": str(recording.path), "live": live, "start_s": start_s, "map": known is not None}
    with Outputs(out, {"run": asked, **as_table(config)}) as outputs, stopped_by_interrupt(recording):
        begun_s, compiled_s = time.perf_counter(), compile_seconds()
        told = watcher.events(outputs.event) if watcher else outputs.event
        slam = Slam(recording.rig, config, map=known, on_event=told, live=live, anchors=anchors)
        mapped, first_ns, last_ns = 0, None, 0
        source, fixes = (watcher.of(recording), watcher.lights(fixes)) if watcher else (recording, fixes)
        for estimate in track(slam.run(source, start_s, end_s, fixes), "SLAM", recording.n_frames or None):
            details = dict(estimate.details)
            outputs.frame(estimate, details.pop("track_ms"), sum(slam.mapping_ms[mapped:]), **details)
            mapped = len(slam.mapping_ms)
            first_ns, last_ns = first_ns or estimate.t_ns, estimate.t_ns
            if watcher:
                watcher.show(estimate, slam)
        if watcher:
            watcher.finish(slam)
        wall_s = time.perf_counter() - begun_s
        for skipped in recording.skipped:
            outputs.event(skipped.t_ns, "skipped", where=skipped.where, why=skipped.reason)
        save_map(slam.map, out / "map.lode")
        upright: Mode = "yaw" if slam.inertial is not None else "se3"
        return outputs.finish(
            slam.trajectory(), slam.cloud(), {**slam.stats(), "skipped": len(recording.skipped)},
            recording.ground_truth(), wall_s=wall_s, compile_s=compile_seconds() - compiled_s,
            recording_s=(last_ns - (first_ns or last_ns)) * 1e-9,
            align="none" if slam.tags.aligned else upright if slam.metric else "sim3", tags=slam.tags.found(),
        )  # fmt: skip


def _summary(m: dict[str, Any], out: Path) -> str:
    lines = [
        f"{m['frames']} frames, {100 * m['tracked_fraction']:.1f} % localized, {m['keyframes']} keyframes, "
        f"{m['map_points']} points, {m['loops']} loops, {m['relocalizations']} relocalizations",
    ]
    per_frame = m["ms_per_frame"]
    if per_frame["mean"] is not None and m["real_time_factor"] is not None:
        lines.append(
            f"{per_frame['mean']:.1f} ms a frame (p95 {per_frame['p95']:.1f}), real-time factor "
            f"{m['real_time_factor']:.2f}, {m['peak_rss_mb']:.0f} MB"
        )
    for name in ("final", "live"):
        if m["ate"] and m["ate"][name]:
            error = m["ate"][name]
            lines.append(f"ATE {name} {error['rmse_m']:.4f} m, {error['rotation_deg']:.2f} deg ({error['align']})")
    return "\n".join([*lines, f"report: {out / 'report.html'}"])
