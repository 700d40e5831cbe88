"""`lodelight localize`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from lodelight.cli.options import RRD_HELP, VIEW_HELP, WEB_HELP

if TYPE_CHECKING:
    from lodelight.cli.watching import Watcher
    from lodelight.io.recording import Recording
    from lodelight.localizer import LocalizerConfig
    from lodelight.mapping.map import Map
    from lodelight.rig import Rig

app = typer.Typer(add_completion=False)


@app.command(epilog="Example: lodelight localize recordings/later --map out/room/map.lode --out out/later")
def localize(
    source: Path = typer.Argument(..., help="Recording, folder of images, video, or a single image."),
    map_file: Path = typer.Option(..., "--map", help="Map file (map.lode) or the out folder of a run; only read."),
    out: Path = typer.Option(..., help="Folder for trajectory and report; created."),
    sensors: str = typer.Option("", help="mono, stereo or rgbd, also with -inertial; default: all the source has."),
    temporary_points: bool = typer.Option(
        True, "--temporary-points/--no-temporary-points", help="Carry the camera where the map is not enough."
    ),
    rig: Path = typer.Option(None, help="rig.toml, or a calibration file of another tool."),
    live: bool = typer.Option(False, "--live", help="Pace by the stamps, the search beside on its own thread."),
    start: float = typer.Option(0.0, min=0.0, help="Seconds after the first frame."),
    end: float = typer.Option(float("inf"), help="Seconds after the first frame."),
    seed: int = typer.Option(0, help="Seed of every random draw."),
    settings: list[str] = typer.Option([], "--set", help="section.key=value, as ladder.states.good_inliers=80."),
    view: bool = typer.Option(False, "--view", help=VIEW_HELP),
    web: bool = typer.Option(False, "--web", help=WEB_HELP),
    rrd: Path = typer.Option(None, "--rrd", help=RRD_HELP),
    as_json: bool = typer.Option(False, "--json", help="Print metrics.json."),
) -> None:
    """Find and follow a camera in a saved map, which is never changed."""
    from lodelight.cli.map import _file
    from lodelight.cli.run import _summary
    from lodelight.cli.watching import ViewOptions
    from lodelight.errors import ConfigError, RunError
    from lodelight.io.sources import open_source
    from lodelight.localizer import LocalizerConfig
    from lodelight.mapping.store import load_map
    from lodelight.settings import with_settings

    map_file = _file(map_file)
    known = load_map(map_file)
    recording = open_source(source, rig)
    if out.resolve() == map_file.resolve().parent:
        raise ConfigError(f"--out {out} holds the run that made the map; choose another folder")
    wanted = LocalizerConfig(
        sensors=sensors or recording.rig.sensors,
        seed=seed,
        temporary_points=temporary_points,
    )
    config = with_settings(wanted, settings)
    watcher = ViewOptions(view, web, rrd).watcher(recording)
    metrics = localize_to_folder(recording, out, config, known, map_file, live, start, end, watcher)
    if as_json:
        print(json.dumps(metrics, indent=2), flush=True)
    else:
        print(_summary(metrics, out))
        earlier = metrics["final_frames"] - round(metrics["tracked_fraction"] * metrics["frames"])
        if earlier:
            print(f"{earlier} more frames by what came later: followed back from where the camera was found")
        if metrics["frames"] == metrics["final_frames"] == 1:
            print(_where(recording.rig, out), flush=True)
    if watcher:
        watcher.stay()
    if metrics["tracked_fraction"] == 0.0:
        raise RunError(f"{source}: no frame was found in the map; {out / 'events.jsonl'} says why")


def _where(rig: Rig, out: Path) -> str:
    """Where the camera of a single image stood, and where it looked."""
    import numpy as np

    from lodelight.io.covariances import read_covariances
    from lodelight.io.trajectories import read_trajectory

    T_world_cam = read_trajectory(out / "trajectory.tum").pose(0) @ rig.cameras[0].T_body_cam
    _, covariance = read_covariances(out / "covariance.csv")
    sigma_m = float(np.sqrt(np.trace(covariance[0, 3:, 3:])))
    at, along = (", ".join(f"{v:.3f}" for v in vector) for vector in (T_world_cam.t, T_world_cam.R[:, 2]))
    return f"camera at ({at}) m in the map's frame, to {sigma_m:.3f} m, looking along ({along})"


def localize_to_folder(
    recording: Recording,
    out: Path,
    config: LocalizerConfig,
    known: Map,
    map_file: Path,
    live: bool = False,
    start_s: float = 0.0,
    end_s: float = float("inf"),
    watcher: Watcher | None = None,
) -> dict[str, Any]:
    """Localize a recording in a map and write the out folder; returns what `metrics.json` holds.

    watcher : shows it while it goes on
    """
    import cv2

    from lodelight.cli.progress import track
    from lodelight.compiled import compile_seconds
    from lodelight.localizer import Localizer
    from lodelight.report.outputs import Outputs
    from lodelight.settings import as_table
    from lodelight.trajectory import Trajectory

    cv2.setNumThreads(1)  # whole stages run on two threads; image operations that split further only get in the way
    asked = {"source": str(recording.path), "map": str(map_file), "live": live, "start_s": start_s}
    begun_s, compiled_s = time.perf_counter(), compile_seconds()
    localizer = Localizer(recording.rig, known, config, live=live)
    with Outputs(out, {"localize": asked, **as_table(config)}) as outputs:
        localizer.on_event = watcher.events(outputs.event) if watcher else outputs.event
        source = watcher.of(recording) if watcher else recording
        poses, first_ns, last_ns = [], None, 0
        for estimate in track(localizer.run(source, start_s, end_s), "localizing", recording.n_frames):
            details = dict(estimate.details)
            outputs.frame(estimate, details.pop("track_ms"), 0.0, **details)
            first_ns, last_ns = first_ns or estimate.t_ns, estimate.t_ns
            if estimate.localized:
                poses.append((estimate.t_ns, estimate.T_world_body))
            if watcher:
                watcher.show(estimate, localizer)
        if watcher:
            watcher.finish(localizer)
        wall_s = time.perf_counter() - begun_s
        for skipped in recording.skipped:
            outputs.event(skipped.t_ns, "skipped", where=skipped.where, why=skipped.reason)
        final = sorted([*poses, *localizer.earlier], key=lambda pose: pose[0])
        return outputs.finish(
            Trajectory.from_poses([t for t, _ in final], [T for _, T in final]),
            known.points.xyz[known.alive_points],
            {**localizer.stats(), "skipped": len(recording.skipped), "final_frames": len(final)},
            recording.ground_truth(), wall_s=wall_s, compile_s=compile_seconds() - compiled_s,
            recording_s=(last_ns - (first_ns or last_ns)) * 1e-9,
        )  # fmt: skip
