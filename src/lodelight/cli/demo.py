"""`lodelight demo`."""

from __future__ import annotations

from pathlib import Path

import typer

app = typer.Typer(add_completion=False)

DURATION_S = 12.0
SIZE, RATE_HZ = (376, 240), 15.0  # half of a EuRoC camera's: what a laptop renders in seconds
LATER_S, LATER_SIZE = 8.0, (400, 300)


@app.command(epilog="Example: lodelight demo --out demo")
def demo(
    out: Path = typer.Option(Path("lodelight-demo"), help="Folder for the recording and the results; created."),
    seed: int = typer.Option(0, help="Another seed, another building."),
) -> None:
    """Simulate a small building, run what there is on it, say how exact it was."""
    from lodelight.cli.progress import track
    from lodelight.cli.run import slam_to_folder
    from lodelight.io.sources import open_source
    from lodelight.sim.scenarios import simulate
    from lodelight.slam import SlamConfig

    source = out / "office"
    simulate(
        "office", source, seed=seed, duration_s=DURATION_S, size=SIZE, rate_hz=RATE_HZ, lights=False,
        progress=lambda frames, total: track(frames, "rendering", total),
    )  # fmt: skip
    print(f"office    {DURATION_S:g} s of stereo and depth, rendered with exact truth: {source}")
    for sensors in ("rgbd", "stereo"):
        recording = open_source(source)
        metrics = slam_to_folder(recording, out / sensors, SlamConfig(sensors=sensors, seed=seed))
        error = metrics["ate"]["final"]
        print(
            f"{sensors:9} {100 * error['rmse_m']:.1f} cm, {error['rotation_deg']:.2f} deg (ATE RMSE); "
            f"{100 * metrics['tracked_fraction']:.0f} % of {metrics['frames']} frames, "
            f"{metrics['ms_per_frame']['p50']:.0f} ms each: {out / sensors / 'report.html'}"
        )
    _localize(out, seed)


def _localize(out: Path, seed: int) -> None:
    """One other camera, with another lens and in the hand, in the map that stereo made."""
    from lodelight.cli.localize import localize_to_folder
    from lodelight.cli.progress import track
    from lodelight.io.sources import open_source
    from lodelight.localizer import LocalizerConfig
    from lodelight.mapping.store import load_map
    from lodelight.sim.scenarios import simulate

    source, map_file = out / "later", out / "stereo" / "map.lode"
    simulate(
        "office", source, seed=seed, duration_s=LATER_S, motion="hand", cameras=1, lens="equidistant", depth=False,
        size=LATER_SIZE, rate_hz=RATE_HZ, lights=False,
        progress=lambda frames, total: track(frames, "rendering", total),
    )  # fmt: skip
    config = LocalizerConfig(sensors="mono", seed=seed)
    metrics = localize_to_folder(open_source(source), out / "localize", config, load_map(map_file), map_file)
    error = metrics["ate"]["final"]
    print(
        f"localize  {100 * error['rmse_m']:.1f} cm, {error['rotation_deg']:.2f} deg (ATE RMSE); one camera with "
        f"another lens in the stereo map, {100 * metrics['tracked_fraction']:.0f} % of {metrics['frames']} frames: "
        f"{out / 'localize' / 'report.html'}"
    )
