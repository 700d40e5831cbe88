"""`lodelight demo`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import typer

app = typer.Typer(add_completion=False)

SIZE, RATE_HZ = (376, 240), 15.0  # half of a EuRoC camera's: what a laptop renders in seconds
OFFICE_S, LATER_S, LATER_SIZE = 12.0, 8.0, (400, 300)
CARPARK_S, LIGHT_RATE_HZ = 10.0, 8.0


@app.command(epilog="Example: lodelight demo --out demo")
def demo(
    out: Path = typer.Option(Path("lodelight-demo"), help="Folder for the recordings and the results; created."),
    seed: int = typer.Option(0, help="Another seed, other buildings."),
) -> None:
    """Simulate two buildings, run the three systems in them, say how exact each was."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # The second building has nothing to do with the first: with two cores it costs no time.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_silent) as beside:
        gated = beside.submit(_by_lights, out, seed)
        print(_by_signs(out, seed), flush=True)
        print(_in_the_map(out, seed), flush=True)
        print(gated.result())


def _silent() -> None:
    """One progress bar on a terminal is enough."""
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115


def _by_signs(out: Path, seed: int) -> str:
    """Stereo and an IMU in an office whose walls carry signs that nobody surveyed."""
    from lodelight.cli.run import slam_to_folder
    from lodelight.io.sources import open_source
    from lodelight.slam import SlamConfig

    _render("office", out / "office", seed, duration_s=OFFICE_S, size=SIZE, depth=False, lights=False)
    config = SlamConfig(sensors="stereo-inertial", seed=seed)
    metrics = slam_to_folder(open_source(out / "office"), out / "inertial", config)
    return _line("signs", metrics, "stereo and IMU in an office", out / "inertial")


def _by_lights(out: Path, seed: int) -> str:
    """A camera with depth in a car park, its keyframes held to where the ceiling lights say it is."""
    from lodelight.cli.run import light_fixes, slam_to_folder
    from lodelight.io.anchors_toml import read_anchors
    from lodelight.io.sources import open_source
    from lodelight.mapping.light_gate import GateConfig
    from lodelight.slam import SlamConfig

    source = out / "carpark"
    _render(
        "carpark", source, seed, duration_s=CARPARK_S, size=SIZE, cameras=1, depth=True, lights=True,
        light_rate_hz=LIGHT_RATE_HZ,
    )  # fmt: skip
    recording, surveyed = open_source(source), read_anchors(source / "anchors.toml")
    fixes = light_fixes(recording, open_source(source), surveyed, "", "", 0.0, float("inf"))
    config = SlamConfig(sensors="rgbd", seed=seed, gate=GateConfig(use="lights"))
    metrics = slam_to_folder(recording, out / "lights", config, anchors=surveyed, fixes=fixes)
    return _line("lights", metrics, "depth, keyframes held to coded lights, in a car park", out / "lights")


def _in_the_map(out: Path, seed: int) -> str:
    """One other camera, with another lens and in the hand, in the map of the office."""
    from lodelight.cli.localize import localize_to_folder
    from lodelight.io.sources import open_source
    from lodelight.localizer import LocalizerConfig
    from lodelight.mapping.store import load_map

    source, map_file = out / "later", out / "inertial" / "map.lode"
    _render(
        "office", source, seed, duration_s=LATER_S, size=LATER_SIZE, motion="hand", cameras=1, lens="equidistant",
        depth=False, lights=False,
    )  # fmt: skip
    config = LocalizerConfig(sensors="mono", seed=seed)
    metrics = localize_to_folder(open_source(source), out / "localize", config, load_map(map_file), map_file)
    return _line("localize", metrics, "one camera with another lens in the office's map", out / "localize")


def _render(scenario: str, target: Path, seed: int, **choices: Any) -> None:
    from lodelight.cli.progress import track
    from lodelight.sim.scenarios import simulate

    simulate(
        scenario, target, seed=seed, rate_hz=RATE_HZ,
        progress=lambda frames, total: track(frames, f"rendering {target.name}", total), **choices,
    )  # fmt: skip


def _line(name: str, metrics: dict[str, Any], what: str, folder: Path) -> str:
    error = metrics["ate"]["final"]
    return (
        f"{name:9} {100 * error['rmse_m']:.1f} cm, {error['rotation_deg']:.2f} deg (ATE RMSE); {what}; "
        f"{100 * metrics['tracked_fraction']:.0f} % of {metrics['frames']} frames, "
        f"{metrics['ms_per_frame']['p50']:.0f} ms each: {folder / 'report.html'}"
    )
