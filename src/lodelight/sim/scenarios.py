"""From a few words to a recording: named buildings, ways to move, sensors, faults."""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import ConfigError, SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io.listing import ImuTable
from lodelight.io.rig_toml import read_rig
from lodelight.io.stamps import NS_PER_S, ns_from_text
from lodelight.io.text import read_table
from lodelight.io.trajectories import read_trajectory
from lodelight.rig import Rig
from lodelight.sim import rigs
from lodelight.sim.builder import Builder, Building
from lodelight.sim.faults import Faults
from lodelight.sim.gaits import GAITS, generate, lap_seconds
from lodelight.sim.imu import SPECS, TURN_ON, ImuSeries, read_out
from lodelight.sim.lightmap import bake
from lodelight.sim.motion import Motion
from lodelight.sim.paths import another_way
from lodelight.sim.recorder import Simulation, claim, record
from lodelight.sim.space import Space
from lodelight.types import Array

# name: (what it is, the way one moves through it)
SCENARIOS = {
    "office": ("20 x 14 m: open plan, meeting room, library, kitchen and store along a corridor", "walk"),
    "warehouse": ("32 x 22 x 7 m: pallet racks, three aisles, packing areas", "cart"),
    "corridor": ("a loop of 88 m around a block, 18 m of it nearly without texture", "walk"),
    "carpark": ("42 x 30 m: pillar after pillar, bay after bay, little light", "cart"),
    "tunnel": ("a loop of 92 m through rock, dim, with chambers at its corners", "drone"),
}
RIGS = ("standard", "camera", "euroc")
START_NS = 1_600_000_000_000_000_000
LAPS = 1.2  # of the route in a recording whose length is not given: its first fifth is seen twice
WANDERS = 20


@dataclass(frozen=True)
class Request:
    """What to simulate, in plain values; written to `simulation.json` beside the recording.

    duration_s : None = LAPS of the building's route, or the whole trajectory given
    motion : cart, walk, drone or hand; None = the building's own
    path : 0 = the building's route; any other number is a way beside it that starts elsewhere, the same for all seeds
    trajectory : file to fly instead
    place : "auto" puts the trajectory where there is most room, "x,y,z,yaw_deg" moves it; None = as it is, but "auto"
    where it starts outside the building or comes with an `imu_file`: then it was made elsewhere
    imu_file : EuRoC csv to pass through unchanged; needs `trajectory`, on the same clock
    rig : standard (body x forward, z up), camera (the body is camera 0), euroc, or a rig.toml; None = euroc for an
    EuRoC csv, else standard
    depth : of the standard and euroc rigs
    cameras, size, rate_hz, lens, lights, light_rate_hz, imu : of the standard rig; imu: euroc, phone or perfect
    faults : as `Faults.parse` takes them
    """

    scenario: str
    seed: int = 0
    duration_s: float | None = None
    motion: str | None = None
    path: int = 0
    standstill_s: float = 0.0
    changed: bool = False
    trajectory: str | None = None
    place: str | None = None
    imu_file: str | None = None
    rig: str | None = None
    cameras: int = 2
    size: tuple[int, int] = (752, 480)
    rate_hz: float = 20.0
    lens: str = "radtan"
    depth: bool = True
    lights: bool = True
    light_rate_hz: float = 10.0
    imu: str = "euroc"
    faults: tuple[str, ...] = ()


def simulate(
    scenario: str,
    out: str | Path,
    *,
    threads: int = 2,
    progress: Callable[[Iterable[None], int], Iterator[None]] | None = None,
    **choices: Any,
) -> Path:
    """Render a recording of a named building into folder `out` and return it; `choices` are fields of `Request`.

    Raises ConfigError on what cannot be simulated and SourceError on files that cannot be read or written.
    """
    claim(out)
    simulation = prepare(Request(scenario, **choices), threads)
    return record(simulation, out, threads, progress)


def prepare(request: Request, threads: int = 2, lit: bool = True) -> Simulation:
    """Everything but the images: the building with its light (unless not `lit`), the motion in it, the sensors."""
    _check(request)
    rig = _rig(request)
    given = _given_motion(request)
    faults = Faults.parse(request.faults, given.duration_s if given else _duration(request))
    series: ImuSeries | None = None
    if given is not None and request.imu_file is not None:
        series = _passed_imu(Path(request.imu_file), given, request)
    place = unlit(request.scenario, request.seed, request.changed, faults)
    space = Space(place)
    if given is None:
        motion = _route_motion(request, space, faults)
    else:
        motion = _placed(request, given, space)
        space.check(motion)
    if series is None and rig.imu is not None:
        series = read_out(motion, rig.imu, np.random.default_rng([request.seed, 2]), TURN_ON[request.imu])
    given_files = {name: _digest(name) for name in (request.trajectory, request.imu_file, request.rig) if name}
    settings = asdict(request) | {
        "files": {name: digest for name, digest in given_files.items() if digest},
        "trajectory_deviation_m": motion.deviation_m,
        "trajectory_deviation_deg": motion.deviation_deg,
    }
    if lit:  # last, since it takes longest
        bake(place.scene, threads)
    true_rig = faults.true_rig(rig, np.random.default_rng([request.seed, 3]))
    return Simulation(place, motion, true_rig, series, request.seed, faults, rig, settings)


def building(
    name: str, seed: int = 0, changed: bool = False, faults: Faults | None = None, threads: int = 2
) -> Building:
    """A named building with its light baked. Raises ConfigError on an unknown name."""
    out = unlit(name, seed, changed, faults)
    bake(out.scene, threads)
    return out


def unlit(name: str, seed: int = 0, changed: bool = False, faults: Faults | None = None) -> Building:
    """A named building in the dark."""
    module = _module(name)
    builder = Builder(name, seed, module.ROUTE, module.HEIGHT, changed, faults or Faults())
    module.build(builder)
    return builder.finish()


def _module(name: str) -> Any:
    if name not in SCENARIOS:
        raise ConfigError(f"unknown scenario {name!r}; choose one of {', '.join(SCENARIOS)}")
    return importlib.import_module(f"lodelight.sim.buildings.{name}")


def _check(request: Request) -> None:
    """Raises ConfigError on what is not to be had, before any work is done."""
    _module(request.scenario)
    for value, known, what in (
        (request.motion, GAITS, "motion"),
        (request.imu, SPECS, "IMU"),
        (request.lens, ("radtan", "equidistant"), "lens"),
    ):
        if value is not None and value not in known:
            raise ConfigError(f"unknown {what} {value!r}; choose one of {', '.join(known)}")
    for number, what in ((request.duration_s, "duration"), (request.rate_hz, "rate"), (request.light_rate_hz, "rate")):
        if number is not None and not 0.0 < number < 1e5:
            raise ConfigError(f"the {what} must be a positive number, got {number:g}")
    if request.standstill_s < 0.0:
        raise ConfigError(f"the standstill must not be negative, got {request.standstill_s:g} s")
    if request.cameras not in (1, 2):
        raise ConfigError(f"the standard rig has 1 or 2 cameras, not {request.cameras}")
    if min(request.size) < 32 or max(request.size) > 8192:
        raise ConfigError(f"the image size must lie in 32..8192, got {request.size[0]}x{request.size[1]}")
    if request.imu_file is not None and request.trajectory is None:
        raise ConfigError("an IMU file goes with the motion it was recorded in; give its --trajectory too")


def _rig(request: Request) -> Rig:
    name = request.rig
    if name is None:
        name = "euroc" if request.trajectory is not None and request.trajectory.endswith(".csv") else "standard"
    if name == "euroc":
        return rigs.euroc(request.depth)
    if name in RIGS:
        return rigs.standard(
            request.size,
            request.rate_hz,
            request.lens,
            request.depth,
            request.lights,
            light_rate_hz=request.light_rate_hz,
            imu=request.imu,
            body_is_camera=name == "camera",
            cameras=request.cameras,
        )
    if not Path(name).is_file():
        raise ConfigError(f"unknown rig {name!r}; choose one of {', '.join(RIGS)}, or a rig.toml")
    return read_rig(name)


def _digest(name: str) -> str:
    """Of a file's bytes, to see on resuming whether it still is the same; "" where there is none of that name."""
    return hashlib.sha256(Path(name).read_bytes()).hexdigest() if Path(name).is_file() else ""


def _duration(request: Request) -> float:
    if request.duration_s is not None:
        return request.duration_s
    gait = GAITS[request.motion or SCENARIOS[request.scenario][1]]
    return round(LAPS * lap_seconds(gait, _module(request.scenario).ROUTE) + request.standstill_s, 1)


def _route_motion(request: Request, space: Space, faults: Faults) -> Motion:
    """Along the building's route. Where its wander would brush against something, another wander is drawn."""
    duration_s, gait = _duration(request), GAITS[request.motion or SCENARIOS[request.scenario][1]]
    route = space.building.route
    ahead = 0.0 if faults.kidnap_s is None else 0.4 * lap_seconds(gait, route)
    if request.path:
        route = another_way(route, space, gait, np.random.default_rng([request.path, 4]))
    jump = None if faults.kidnap_s is None else (faults.kidnap_s, ahead)
    for draw in range(WANDERS):
        rng = np.random.default_rng([request.seed, 1, *([draw] if draw else [])])
        motion = generate(gait, route, duration_s + ahead, START_NS, rng, request.standstill_s)
        motion = replace(motion, duration_s=duration_s, jump=jump)
        try:
            space.check(motion)
            return motion
        except ConfigError as error:
            touched = error
    raise touched


def _given_motion(request: Request) -> Motion | None:
    """The trajectory of a file as a motion, cut to the length that was asked for."""
    if request.trajectory is None:
        return None
    motion = Motion.fit(read_trajectory(request.trajectory))
    if request.duration_s is not None:
        if request.duration_s > motion.duration_s + 1e-6:
            raise ConfigError(
                f"{request.trajectory} lasts {motion.duration_s:.2f} s, shorter than the {request.duration_s:g} s "
                "asked for; give a shorter --duration"
            )
        motion = replace(motion, duration_s=request.duration_s)
    return motion


def _placed(request: Request, motion: Motion, space: Space) -> Motion:
    if request.place is None and request.imu_file is None and space.indoors(motion.at(0.0).xyz[0]):
        return motion
    if request.place in (None, "auto"):
        return motion.moved(space.place(motion))
    try:
        x, y, z, yaw = (float(v) for v in str(request.place).split(","))
    except ValueError:
        raise ConfigError(f"--place {request.place!r} must be auto, or x,y,z,yaw in m and degrees") from None
    a = np.radians(yaw)
    R = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    return motion.moved(SE3(R, np.array([x, y, z])))


def _passed_imu(path: Path, motion: Motion, request: Request) -> ImuSeries:
    """Rows of a real IMU within the motion, unchanged; biases where the trajectory's file tells them, else 0."""
    table = ImuTable.read(path)
    end = motion.start_ns + round(motion.duration_s * NS_PER_S)
    inside = (table.t_ns >= motion.start_ns) & (table.t_ns <= end)
    if inside.sum() < 2:
        raise SourceError(f"{path} has no samples during the trajectory; both must be on one clock")
    t_ns = table.t_ns[inside]
    bias = _told_biases(Path(str(request.trajectory)), t_ns)
    return ImuSeries(t_ns, table.gyro[inside], table.accel[inside], bias[:, :3], bias[:, 3:])


def _told_biases(path: Path, t_ns: NDArray[np.int64]) -> Array:
    """(N, 6) gyro and accelerometer biases of an EuRoC truth file at stamps; 0 where it has none."""
    table = read_table(path, 16, ns_from_text) if path.suffix == ".csv" else None
    if table is None or len(table.t_ns) < 2:
        return np.zeros((len(t_ns), 6))
    since = table.t_ns[0]
    return np.stack([np.interp(t_ns - since, table.t_ns - since, table.values[:, 10 + k]) for k in range(6)], axis=1)
