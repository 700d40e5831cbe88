"""From a few words to a recording: named buildings, ways to move, sensors."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from lodelight.errors import ConfigError
from lodelight.rig import Rig
from lodelight.sim.builder import Building
from lodelight.sim.gaits import GAITS, generate
from lodelight.sim.imu import TURN_ON, read_out
from lodelight.sim.lightmap import bake
from lodelight.sim.recorder import Simulation, record
from lodelight.sim.rigs import standard

SCENARIOS = {
    "office": ("rooms and doors along a corridor, 20 x 14 m", "walk"),
}
START_NS = 1_600_000_000_000_000_000


def building(name: str, seed: int = 0, changed: bool = False, threads: int = 2) -> Building:
    """A named building with its light baked. Raises ConfigError on an unknown name."""
    if name not in SCENARIOS:
        raise ConfigError(f"unknown scenario {name!r}; choose one of {', '.join(SCENARIOS)}")
    module = importlib.import_module(f"lodelight.sim.buildings.{name}")
    out: Building = module.build(seed, changed)
    bake(out.scene, threads)
    return out


def simulate(
    scenario: str,
    out: str | Path,
    seed: int = 0,
    duration_s: float = 60.0,
    motion: str | None = None,
    rig: Rig | None = None,
    imu: str = "euroc",
    standstill_s: float = 0.0,
    changed: bool = False,
    threads: int = 2,
    progress: Callable[[Iterable[None], int], Iterator[None]] | None = None,
) -> Path:
    """Render a recording of a named building into folder `out` and return it."""
    rig = rig or standard(imu=imu)
    place = building(scenario, seed, changed, threads)
    kind = motion or SCENARIOS[scenario][1]
    if kind not in GAITS:
        raise ConfigError(f"unknown motion {kind!r}; choose one of {', '.join(GAITS)}")
    way = generate(GAITS[kind], place.route, duration_s, START_NS, np.random.default_rng([seed, 1]), standstill_s)
    series = read_out(way, rig.imu, np.random.default_rng([seed, 2]), TURN_ON[imu]) if rig.imu else None
    settings = {"scenario": scenario, "seed": seed, "duration_s": duration_s, "motion": kind, "changed": changed}
    return record(Simulation(place, way, rig, series, seed, settings), out, threads, progress)
