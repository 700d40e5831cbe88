"""What lights are worth to SLAM: `python benchmarks/gate.py RECORDINGS [--modes none,centre,chi2,patent,tight]`.

RECORDINGS are folders made by `lodelight sim` (any size; `--render FOLDER` makes those of the table). Where one has a
light camera, its images are read; else, and with `--simulated`, fixes are simulated along the truth, by the receiver's
own noise as benchmarks/lights.py measured it: rendering that camera costs more than all the rest. `--moved` surveys the
light that is seen most 1 m off, `--swapped` swaps the two.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from light_scenes import along
from lodelight.anchors import Anchors, Light
from lodelight.cli.lights import light_frames
from lodelight.evaluation.associate import matched
from lodelight.evaluation.ate import ate
from lodelight.io.anchors_toml import read_anchors
from lodelight.io.sources import open_source
from lodelight.rig import Rig
from lodelight.settings import with_settings
from lodelight.sim import rigs
from lodelight.sim.scenarios import simulate
from lodelight.slam import Slam, SlamConfig
from lodelight.trajectory import Trajectory

SIZE, RATE_HZ, DURATION_S = (376, 240), 15.0, 20.0
WITH_LIGHT_CAMERA = (1,)  # seeds
MODES = {
    "none": [],
    "centre": ["gate.use=lights"],
    "chi2": ["gate.use=lights", "gate.mode=chi2"],
    "patent": ["gate.use=lights", "gate.mode=patent"],
    "only": ["gate.use=lights", "gate.anchor=false"],
    "tight": ["lights.use=tight"],
}


def render(folder: Path, seeds: int) -> list[Path]:
    """Moving boxes, three blurred seconds; one camera with depth, since nothing else is needed here."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for building in ("office", "carpark"):
        for seed in range(seeds):
            out = folder / f"gate_{building}_s{seed}"
            simulate(
                building, out, seed=seed, duration_s=DURATION_S, size=SIZE, rate_hz=RATE_HZ, cameras=1,
                lights=seed in WITH_LIGHT_CAMERA, faults=("people=6", "blur=12:3"),
            )  # fmt: skip
            made.append(out)
    return made


def surveyed(lights, fixes, fault):
    """The survey with a fault in the lights that are seen most."""
    often = [name for name, _ in Counter(name for fix in fixes for name in fix.lights).most_common(2)]
    if fault == "moved":
        return tuple(
            replace(k, xyz=k.xyz + np.array([1.0, 0.0, 0.0])) if k.id == often[0] else k for k in lights
        ), often[:1]
    by_id = {light.id: light for light in lights}
    partner = dict(zip(often, often[::-1], strict=True))
    return tuple(replace(k, xyz=by_id[partner[k.id]].xyz) if k.id in partner else k for k in lights), often


def fixes_of(source: Path, rig: Rig, lights: tuple[Light, ...], true: tuple[Light, ...], simulated: bool):
    """By the rendered light camera, or along the truth, of lights that hang where `true` says."""
    recording = open_source(source)
    if not simulated:
        return [read.fix for read in light_frames(recording, Anchors(lights=lights))]
    known = lights if lights is not true else None
    return along(recording.ground_truth(), true, rig.lights, np.random.default_rng(0), known=known)


def run(source: Path, mode: str, settings: list[str], end_s: float, fault: str, simulated: bool) -> None:
    recording = open_source(source)
    truth = recording.ground_truth()
    simulated = simulated or recording.rig.lights is None
    rig = replace(recording.rig, lights=recording.rig.lights or rigs.standard().lights)
    true, told = read_anchors(source / "anchors.toml").lights, []
    lights, fixes = true, fixes_of(source, rig, true, true, simulated) if mode != "none" else []
    if fault and fixes:
        lights, told = surveyed(true, fixes, fault)
        fixes = fixes_of(source, rig, lights, true, simulated)
    config = with_settings(SlamConfig(sensors="rgbd"), [*MODES[mode], *settings])
    events = []
    slam = Slam(rig, config, anchors=Anchors(lights=lights), on_event=lambda t, kind, **f: events.append((t, kind, f)))
    began, statuses = time.process_time(), Counter()
    for estimate in slam.run(recording, 0.0, end_s, fixes):
        statuses[estimate.status] += 1
    final = slam.trajectory()
    pairs = matched(final, truth)
    alive = slam.map.alive_keyframes
    held = Trajectory.from_poses(slam.map.keyframes.t_ns[alive].tolist(), [slam.map.pose(int(k)) for k in alive])
    stats = slam.stats()
    named = sorted({f["light"] for _, kind, f in events if kind == "light_misplaced"})
    of_map = ate(*matched(held, truth), "se3").rmse_m
    what = " ".join(filter(None, [source.name, mode, fault, "" if simulated or mode == "none" else "rendered"]))
    print(
        f"{what}: ATE se3 {ate(*pairs, 'se3').rmse_m:.4f}, "
        f"none {ate(*pairs, 'none').rmse_m:.4f} m, keyframes' se3 {of_map:.4f}; "
        f"{stats['keyframes']} keyframes, {statuses['lost']} lost, "
        f"{statuses['relocalized']} relocalized, {stats['loops']} loops, gate {stats.get('gate')}"
        + (f", told {told}, named {named}" if fault else "")
        + f", CPU {time.process_time() - began:.0f} s",
        flush=True,
    )
    for t, kind, f in events:
        if kind in ("world", "gate_blame", "light_misplaced", "light_clock"):
            print(f"    {(t - int(truth.t_ns[0])) * 1e-9:.2f} s {kind}: {f['why']}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--render", type=Path, help="render the recordings of the table into this folder first")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--modes", default="none,centre")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--end", type=float, default=float("inf"))
    parser.add_argument("--simulated", action="store_true")
    parser.add_argument("--moved", action="store_true")
    parser.add_argument("--swapped", action="store_true")
    asked = parser.parse_args()
    sources = asked.recordings + (render(asked.render, asked.seeds) if asked.render else [])
    for source in sources:
        for mode in asked.modes.split(","):
            fault = "moved" if asked.moved else "swapped" if asked.swapped else ""
            run(source, mode, asked.set, asked.end, fault, asked.simulated)
