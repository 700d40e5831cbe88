"""What the inertial system rests on: `python benchmarks/inertial.py imu|starts|consistency|tracks|loop|memory FOLDER`.

imu FOLDER : an EuRoC recording with groundtruth/*.csv; its IMU against its truth, as a density by averaging time
starts FOLDER : of the same; starts in flight along it, with its IMU and simulated tracks: how many are wrong
consistency FOLDER : of any recording with truth; starts along it, one camera, with its images or, `--simulated`, with
    tracks along its truth: error and NEES of the velocity in the body's frame and of the tilt, and how fast it seems
tracks FOLDER : a rendered recording (`lodelight sim`); how far tracks leave their points, by frames in between
loop FOLDER : render a minute through the office, there and back, that ends where and as it began
memory FOLDER : such a recording, flown again and again for 30 minutes
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import sys
import tempfile
from collections import defaultdict
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from lodelight.features.klt import KltTracker
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew
from lodelight.imu.preintegration import preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.io.listing import ImuTable
from lodelight.io.sources import open_source
from lodelight.io.trajectories import read_trajectory, write_tum
from lodelight.memory import resident_bytes
from lodelight.messages import Frame, Imu
from lodelight.odometry.inertial import InertialOdometry, OdometryStep
from lodelight.report.metrics import peak_rss_mb
from lodelight.report.outputs import Outputs
from lodelight.rig import ImuSpec
from lodelight.sim import rigs
from lodelight.sim.motion import GRAVITY, Motion
from lodelight.sim.scenarios import Request, prepare, simulate
from lodelight.sim.space import Space
from lodelight.slam import Slam, SlamConfig
from lodelight.trajectory import Trajectory
from odometry_scenes import Points

STEP_S = 0.05


def flown(folder: Path) -> tuple[Motion, ImuTable]:
    truth = next(iter((folder / "groundtruth").glob("*.csv")))
    return Motion.fit(read_trajectory(truth)), ImuTable.read(folder / "mav0" / "imu0" / "data.csv")


def imu(folder: Path) -> None:
    motion, table = flown(folder)
    second = {name: np.diff(getattr(table, name), 2, axis=0) for name in ("gyro", "accel")}
    period = float(np.median(np.diff(table.t_ns))) * 1e-9
    for name, d in second.items():
        print(f"{name}: samples show a density of {np.sqrt((d**2).mean() / 6.0 * period):.5f}")
    t_ns = motion.start_ns + np.arange(int(12e9), int((motion.duration_s - 8.0) * 1e9), round(STEP_S * 1e9))
    states, none = motion.at_ns(t_ns), np.zeros(3)
    turn, push = [], []
    for i in range(len(t_ns) - 1):
        lo, hi = np.searchsorted(table.t_ns, t_ns[i], "right") - 1, np.searchsorted(table.t_ns, t_ns[i + 1]) + 1
        samples = ImuSamples(table.t_ns[lo:hi], table.gyro[lo:hi], table.accel[lo:hi])
        moved = preintegrate(samples.between(int(t_ns[i]), int(t_ns[i + 1])), none, none, ImuSpec())
        R = states.R_world_body[i]
        turn.append(Rotation.from_matrix(moved.dR.T @ R.T @ states.R_world_body[i + 1]).as_rotvec() / STEP_S)
        dv = states.v_world[i + 1] - states.v_world[i] - GRAVITY * STEP_S
        push.append((R.T @ dv - moved.dv) / STEP_S)
    for name, rate in (("gyro, rad/s", np.array(turn)), ("accel, m/s^2", np.array(push))):
        for n in (4, 8, 16, 32, 64, 128):
            mean = rate[: len(rate) // n * n].reshape(-1, n, 3).mean(axis=1)
            allan = np.sqrt(0.5 * (np.diff(mean, axis=0) ** 2).mean())
            print(f"{name}, {n * STEP_S:.1f} s: Allan deviation {allan:.5f}, density {allan * np.sqrt(n * STEP_S):.5f}")


def starts(folder: Path, every_s: float = 4.1) -> None:
    motion, table = flown(folder)
    wrong, took = 0, []
    for begin in np.arange(7.0, motion.duration_s - 7.0, every_s):
        t0 = motion.start_ns + int(begin * 1e9)
        odometry = InertialOdometry(rigs.euroc(False), "mono")
        odometry.tracker = Points(motion, odometry.rig, 0, 0.07)  # type: ignore[assignment]
        near = np.flatnonzero((table.t_ns >= t0 - 20_000_000) & (table.t_ns < t0 + 4_000_000_000))
        messages: list[Imu | Frame] = [Imu(int(table.t_ns[i]), table.gyro[i], table.accel[i]) for i in near]
        messages += [Frame(t0 + k * 50_000_000, ()) for k in range(78)]
        for message in sorted(messages, key=lambda m: m.t_ns):
            step = odometry.feed_frame(message) if isinstance(message, Frame) else odometry.feed_imu(message)
            if step is not None and step.status == "tracking":
                true = motion.at_ns(np.array([step.frame.t_ns]))
                body = step.state.T_world_body.R.T @ step.state.v_world
                off = float(np.linalg.norm(body - true.R_world_body[0].T @ true.v_world[0]))
                took.append((step.frame.t_ns - t0) * 1e-9)
                wrong += off > 0.1
                break
    print(f"{len(took)} starts, {wrong} with a velocity off by more than 0.1 m/s; within {max(took):.2f} s")


def consistency(folder: Path, simulated: bool = False, every_s: float = 0.5, run_s: float = 4.3) -> None:
    recording = open_source(folder)
    truth = recording.ground_truth()
    assert truth is not None
    motion, messages = Motion.fit(truth), list(recording.messages("mono-inertial"))
    stamps = [m.t_ns for m in messages if isinstance(m, Frame)]
    if simulated:  # in a room around the way
        flown = motion.at_ns(np.array(stamps)).xyz
        half = 0.5 * (flown.max(axis=0) - flown.min(axis=0))
        there = motion.moved(SE3(np.eye(3), [0.0, 0.0, 2.5] - 0.5 * (flown.max(axis=0) + flown.min(axis=0))))
    found: dict[int, list[list[float]]] = defaultdict(list)
    for begin in np.arange(0.0, (stamps[-1] - stamps[0]) * 1e-9 - run_s, every_s):
        t0, started = stamps[0] + int(begin * 1e9), -1
        odometry = InertialOdometry(recording.rig, "mono")
        if simulated:
            room = (half[0] + 4.0, half[1] + 4.0, half[2] + 5.0)
            odometry.tracker = Points(there, odometry.rig, 0, 0.07, room=room)  # type: ignore[assignment]
        for message in messages:
            if not t0 - 20_000_000 <= message.t_ns <= t0 + run_s * 1e9:
                continue
            if isinstance(message, Imu):
                step = odometry.feed_imu(message)
            elif isinstance(message, Frame) and message.t_ns >= t0:
                step = odometry.feed_frame(Frame(message.t_ns, ()) if simulated else message)
            if step is None or step.status != "tracking":
                continue
            started = step.frame.t_ns if started < 0 else started
            seconds = (step.frame.t_ns - started) * 1e-9
            if abs(seconds - round(seconds)) < 0.4 * STEP_S:
                found[round(seconds)].append(_off(step, motion))
    for seconds, rows in sorted(found.items()):
        off = np.array(rows)
        print(
            f"{seconds} s after {len(off)} starts: velocity off by {np.sqrt((off[:, 0] ** 2).mean()):.3f} m/s, NEES "
            f"{off[:, 1].mean():.2f}, {100.0 * off[:, 2].sum() / off[:, 3].sum():+.1f} % too fast; tilt off by "
            f"{np.degrees(np.sqrt((off[:, 4] ** 2).mean())):.2f} deg, NEES {off[:, 5].mean():.2f}"
        )


def _off(step: OdometryStep, motion: Motion) -> list[float]:
    """Error and NEES of the velocity in the body's frame, by how much it is too fast times its square, its square;
    error and NEES of the tilt."""
    true = motion.at_ns(np.array([step.frame.t_ns]))
    R, R_true = step.state.T_world_body.R, true.R_world_body[0]
    v, v_true = R.T @ step.state.v_world, R_true.T @ true.v_world[0]
    J = np.zeros((3, 15))
    J[:, :3], J[:, 6:9] = skew(v), R.T
    off, P = v - v_true, J @ step.covariance @ J.T
    across = np.linalg.svd(R[2][None])[2][1:]
    tilt = across @ np.cross(R[2], R_true[2])
    Q = across @ step.covariance[:3, :3] @ across.T
    nees = off @ np.linalg.solve(P, off) / 3.0, tilt @ np.linalg.solve(Q, tilt) / 2.0
    return [float(np.linalg.norm(off)), nees[0], off @ v_true, v_true @ v_true, float(np.linalg.norm(tilt)), nees[1]]


def tracks(folder: Path, start_s: float = 12.0, end_s: float = 24.0) -> None:
    asked = json.loads((folder / "simulation.json").read_text())
    names = {field.name for field in fields(Request)}
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in asked.items() if k in names}
    simulation = prepare(Request(**values), 1, lit=False)
    space, recording = Space(simulation.building), open_source(folder)
    spec, errors, points = recording.rig.cameras[0], defaultdict(list), {}
    tracker, last = KltTracker(recording.rig, "mono"), None
    for message in recording.messages("mono", start_s, end_s):
        if not isinstance(message, Frame):
            continue
        T = simulation.motion.at_ns(np.array([message.t_ns])).poses()[0] @ spec.T_body_cam
        seen = tracker.process(message, None if last is None else T.R.T @ last.R, 2e-3)
        last = T
        for number, px, ray in zip(seen.id.tolist(), seen.px, seen.ray, strict=True):
            if number not in points:
                points[number] = T.t + space._cast(T.t, T.R @ ray, 50.0)[0] * (T.R @ ray)
            errors[number].append(px - spec.camera.project(T.inverse() @ points[number][None])[0][0])
    for gap in (1, 2, 4, 8, 16, 32):
        change = np.vstack([np.array(e[gap:]) - np.array(e[:-gap]) for e in errors.values() if len(e) > gap])
        print(f"{gap} frames: {1.4826 * np.median(np.abs(change)):.3f} px an axis (1.48 times the median)")


def loop(folder: Path, lap_s: float = 60.0, way_s: float = 28.0) -> None:
    t = np.arange(0.0, lap_s + 1e-9, 0.02)
    way = prepare(Request("office", seed=5, duration_s=way_s + 2.0, motion="drone"), 1, lit=False).motion
    state = way.at(0.5 + 0.5 * way_s * (1.0 - np.cos(2.0 * np.pi * t / lap_s)))
    there_and_back = Trajectory(
        10**12 + np.round(t * 1e9).astype(np.int64), state.xyz, state.quat_wxyz[:, [1, 2, 3, 0]]
    )
    with tempfile.TemporaryDirectory() as scratch:
        write_tum(Path(scratch) / "loop.tum", there_and_back)
        simulate(
            "office", folder, seed=5, trajectory=str(Path(scratch) / "loop.tum"), imu="perfect", size=(376, 240),
            rate_hz=8.0, depth=False, lights=False,
        )  # fmt: skip


def memory(folder: Path, minutes: float = 30.0, every_min: float = 2.0) -> None:
    slam: Slam | None = None
    shift = frames = localized = 0
    told = 0.0
    with tempfile.TemporaryDirectory() as out, Outputs(Path(out), {}) as outputs:
        while shift < minutes * 60e9:
            recording = open_source(folder)
            if slam is None:
                slam = Slam(recording.rig, SlamConfig(sensors=recording.rig.sensors), on_event=outputs.event)
            first_ns, last_ns = recording.span_ns
            lap_ns = last_ns - first_ns
            for message in recording.messages(slam.config.sensors):
                if message.t_ns < first_ns or message.t_ns >= last_ns:
                    continue
                estimate = slam.feed(replace(message, t_ns=message.t_ns + shift))
                if estimate is None:
                    continue
                details = dict(estimate.details)
                outputs.frame(estimate, details.pop("track_ms"), 0.0, **details)
                frames, localized = frames + 1, localized + estimate.localized
                now = (estimate.t_ns - first_ns) / 60e9
                if now >= told + every_min:
                    told += every_min
                    k = slam.map.keyframes
                    print(
                        f"minute {told:4.0f}: {resident_bytes() / 2**20:4.0f} MB (most so far {peak_rss_mb():.0f}), "
                        f"{int(k.alive.sum())} of {len(k)} keyframes, {len(slam.map.alive_points)} points, "
                        f"{localized} of {frames} frames", flush=True,
                    )  # fmt: skip
            shift += lap_ns
    assert slam is not None
    slam.close()
    print(f"all adjusted: {resident_bytes() / 2**20:.0f} MB (most {peak_rss_mb():.0f})")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("what", choices=("imu", "starts", "consistency", "tracks", "loop", "memory"))
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--simulated", action="store_true")
    options = arguments.parse_args()
    if options.what == "consistency":
        consistency(options.folder, options.simulated)
        sys.exit()
    {"imu": imu, "starts": starts, "tracks": tracks, "loop": loop, "memory": memory}[options.what](options.folder)
