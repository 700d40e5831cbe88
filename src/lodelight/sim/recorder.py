"""A recording from a building, a motion and a rig: rendered in parallel, written in order, resumed after a kill."""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.io.anchors_toml import write_anchors
from lodelight.io.euroc_writer import (
    IMU_HEADER,
    TRUTH,
    TRUTH_HEADER,
    append_image,
    append_imu,
    append_truth,
    stored_depth,
    write_sensors,
    written_stamps,
)
from lodelight.io.stamps import NS_PER_S
from lodelight.io.text import read_text, write_text
from lodelight.io.trajectories import write_tum
from lodelight.rig import CameraSpec, Rig
from lodelight.sim.builder import Building
from lodelight.sim.contact import write_contact_sheet
from lodelight.sim.depth import sense_depth
from lodelight.sim.faults import Faults
from lodelight.sim.imager import Imager
from lodelight.sim.imu import ImuSeries
from lodelight.sim.metering import exposures
from lodelight.sim.motion import Motion
from lodelight.sim.plan import write_plan
from lodelight.sim.sensor import Exposure, seed_of
from lodelight.trajectory import Trajectory
from lodelight.types import AnyArray

LIGHT_GAIN = 1.0
SETTINGS = "simulation.json"


@dataclass(frozen=True, eq=False)
class Simulation:
    """All that determines a recording: the same values give the same bytes.

    rig : as it is; stated : as it is written down, None = the same
    settings : what it was made from, in plain values; written beside the recording and compared on resuming
    """

    building: Building
    motion: Motion
    rig: Rig
    imu: ImuSeries | None
    seed: int = 0
    faults: Faults = field(default_factory=Faults)
    stated: Rig | None = None
    settings: dict[str, object] = field(default_factory=dict)

    def stamps(self, spec: CameraSpec) -> NDArray[np.int64]:
        """Stamps of a camera's images, ns: every 1 / rate from the start of the motion on."""
        count = int(np.floor(self.motion.duration_s * spec.rate_hz + 1e-9)) + 1
        true = self.motion.start_ns + np.round(np.arange(count) * (NS_PER_S / spec.rate_hz)).astype(np.int64)
        return true - round(spec.time_offset_s * NS_PER_S)

    @property
    def summary(self) -> dict[str, object]:
        """What was simulated, for a person or a script."""
        return {
            "duration_s": round(self.motion.duration_s, 3),
            "path_m": round(self.motion.trajectory(20.0).length_m, 2),
            "tags": len(self.building.anchors.tags),
            "lights": len(self.building.anchors.lights),
            "trajectory_deviation_m": round(self.motion.deviation_m, 5),
            "trajectory_deviation_deg": round(self.motion.deviation_deg, 4),
        }


Shot = dict[str, AnyArray]  # folder: image
Job = tuple[int, list[str], Callable[[], Shot]]  # stamp, folders it fills, the work


def record(
    simulation: Simulation,
    out: str | Path,
    threads: int = 2,
    progress: Callable[[Iterable[None], int], Iterator[None]] | None = None,
) -> Path:
    """Write the recording to `out`, an EuRoC folder with rig.toml, anchors.toml and truth.tum beside `mav0`.

    A folder that holds the beginning of the same recording is continued. Raises SourceError where it holds anything
    else or cannot be written. progress : wraps the rendering, given the steps and their number.
    """
    out = Path(out)
    claim(out, simulation.settings)
    folders = write_sensors(out, simulation.stated or simulation.rig, str(simulation.settings.get("scenario", "")))
    _write_texts(simulation, out, folders)
    done = {name: set(written_stamps(folder)) for name, folder in folders.items() if (folder / "data.csv").exists()}
    jobs = [job for job in _jobs(simulation) if any(job[0] not in done[name] for name in job[1])]
    steps = _run(jobs, folders, done, threads)
    for _ in progress(steps, len(jobs)) if progress else steps:
        pass
    write_contact_sheet(out)
    return out


def claim(out: str | Path, settings: dict[str, object] | None = None) -> None:
    """Take a new or empty folder, or one that the same simulation began. Raises SourceError on any other.

    settings : None = not known yet; then only what can be told without them is
    """
    out = Path(out)
    text = json.dumps(settings, indent=2, sort_keys=True) + "\n"
    try:
        out.mkdir(parents=True, exist_ok=True)
        holds = sorted(p.name for p in out.iterdir())
    except OSError as error:
        raise SourceError(f"cannot write to {out}: {error.strerror}; choose another --out") from None
    if not os.access(out, os.W_OK):
        raise SourceError(f"cannot write to {out}: no permission; choose another --out")
    if holds and SETTINGS not in holds:
        raise SourceError(f"{out} is not empty ({holds[0]} is there); choose a new folder for --out")
    if settings is None:
        return
    if not holds:
        write_text(out / SETTINGS, text)
    elif read_text(out / SETTINGS) != text:
        raise SourceError(
            f"{out} holds a recording made with other settings (see its {SETTINGS}); choose another --out"
        )


def _write_texts(simulation: Simulation, out: Path, folders: dict[str, Path]) -> None:
    """All that needs no rendering: anchors, truth, inertial data."""
    write_anchors(out / "anchors.toml", simulation.building.anchors)
    for name in ("plan.png", "plan.html"):
        write_plan(out / name, simulation.building, simulation.motion)
    imu, motion = simulation.imu, simulation.motion
    t_ns = imu.t_ns if imu is not None else simulation.stamps(simulation.rig.cameras[0])
    t_ns = t_ns[(t_ns >= motion.start_ns) & (t_ns <= motion.start_ns + round(motion.duration_s * NS_PER_S))]
    state = motion.at_ns(t_ns)
    quat = state.quat_wxyz
    write_tum(out / "truth.tum", Trajectory(t_ns, state.xyz, quat[:, [1, 2, 3, 0]]))
    zero = np.zeros_like(state.xyz)
    bias = (zero, zero)
    if imu is not None:
        write_text(folders["imu0"] / "data.csv", IMU_HEADER)
        append_imu(folders["imu0"], imu.t_ns, imu.gyro, imu.accel)
        inside = np.isin(imu.t_ns, t_ns)
        bias = imu.bias_gyro[inside], imu.bias_accel[inside]
    write_text(folders[TRUTH] / "data.csv", TRUTH_HEADER)
    append_truth(folders[TRUTH], t_ns, state.xyz, quat, state.v_world, *bias)


def _jobs(simulation: Simulation) -> list[Job]:
    """Every image of every camera by time; registered depth comes with the image of camera 0."""
    rig, motion, faults = simulation.rig, simulation.motion, simulation.faults
    lead = rig.cameras[0]
    metered_ns = simulation.stamps(lead) + round(lead.time_offset_s * NS_PER_S)
    metered = exposures(simulation.building, lead, motion, simulation.stamps(lead))
    kept = faults.kept(len(metered), np.random.default_rng([simulation.seed, 5]))
    cameras = [(f"cam{i}", spec) for i, spec in enumerate(rig.cameras)]
    if rig.depth is not None and not rig.depth.registered:
        cameras.append(("depth0", CameraSpec("depth0", rig.depth.camera, rig.depth.T_body_depth, lead.rate_hz)))
    if rig.lights is not None:
        cameras.append(("light0", rig.lights))
    jobs: list[Job] = []
    for number, (name, spec) in enumerate(cameras):
        imager = Imager(simulation.building, spec, motion)
        names = [name, "depth0"] if number == 0 and rig.depth is not None and rig.depth.registered else [name]
        for index, t in enumerate(simulation.stamps(spec).tolist()):
            at = t + round(spec.time_offset_s * NS_PER_S)
            last = max(0, int(np.searchsorted(metered_ns, at, side="right")) - 1)  # of camera 0, at this time
            if name == "light0":
                exposure = Exposure(spec.exposure_s, LIGHT_GAIN)
            elif kept[last]:
                exposure = faults.smeared(imager.true_s(t), metered[last])
            else:
                continue
            jobs.append((t, names, _shot(simulation, imager, names, t, exposure, number, index)))
    return sorted(jobs, key=lambda job: (job[0], job[1]))


def _shot(
    simulation: Simulation, imager: Imager, names: list[str], t_ns: int, exposure: Exposure, number: int, index: int
) -> Callable[[], Shot]:
    def work() -> Shot:
        covered = simulation.faults.dark(imager.true_s(t_ns))
        image, view = imager.take(t_ns, exposure, seed_of(simulation.seed, number, index), covered)
        shot: Shot = {name: image for name in names if name != "depth0"}
        if "depth0" in names and simulation.rig.depth is not None:
            depth = sense_depth(view.depth, simulation.rig.depth, seed_of(simulation.seed, 100 + number, index))
            shot["depth0"] = stored_depth(depth, simulation.rig.depth)
        return shot

    return work


def _run(jobs: list[Job], folders: dict[str, Path], done: dict[str, set[int]], threads: int) -> Iterator[None]:
    """Work ahead on `threads`, write in order; never more than a few images in memory."""
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[tuple[int, Future[Shot]]] = deque()
        ahead = iter(jobs)
        try:
            while True:
                while len(waiting) < 2 * threads + 1 and (job := next(ahead, None)) is not None:
                    waiting.append((job[0], pool.submit(job[2])))
                if not waiting:
                    return
                t_ns, future = waiting.popleft()
                for name, image in future.result().items():
                    if t_ns not in done[name]:
                        append_image(folders[name], t_ns, image)
                yield
        finally:
            for _, future in waiting:
                future.cancel()
