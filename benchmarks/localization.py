"""Localization in a saved map, measured: `python benchmarks/localization.py TASK ...`

blocks RECORDING --length 30    map from even blocks of a recording with depth, queries from odd ones, colour alone
pair RUN RECORDING QUERY        a recording in the map that `lodelight run RECORDING --out RUN` made
simulated office --seed 1       renders a stereo recording for the map, another camera on another way, and that one
                                again in the changed building; maps, and localizes them, the last by the map alone too
wrong RUN RECORDING QUERY OTHER ...   frames of QUERY, and of other buildings, of which none may be found there
kidnap RUN RECORDING QUERY      50 times: 10 s of darkness, then another known place
speed QUERY --keyframes 1000    global relocalization in a map of so many keyframes, of a recording with depth
memory RUN QUERY --minutes 30   a recording over and over, its frames decoded once
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from lodelight.evaluation.associate import matched
from lodelight.geometry.se3 import SE3
from lodelight.io.sources import open_source
from lodelight.io.trajectories import read_trajectory
from lodelight.localizer import Localizer, LocalizerConfig
from lodelight.mapping.map import Map
from lodelight.mapping.store import load_map
from lodelight.memory import resident_bytes
from lodelight.messages import Estimate, Frame
from lodelight.settings import with_settings
from lodelight.slam import Slam, SlamConfig
from lodelight.trajectory import Trajectory

MAP_S, QUERY_S = 36, 24  # on foot, side by side; the map goes on to what the query sees at its end
SIGMA_M, SIGMA_RAD = 0.02, 0.02  # errors of a run: how positions and attitudes weigh when frames are laid together


def mapped(recording, frames: list[Frame], sensors: str) -> Slam:
    """SLAM over some frames of a recording."""
    slam = Slam(recording.rig, SlamConfig(sensors=sensors))
    for frame in frames:
        slam.feed(frame)
    slam.close()
    return slam


class Query:
    """Frames through a localizer: estimates, poses known in the end, and CPU ms of each frame that was followed."""

    def __init__(self, rig, map: Map, frames: Any, given: argparse.Namespace) -> None:
        config = LocalizerConfig(sensors=given.sensors, temporary_points=not given.no_temporary_points)
        self.events: list[dict[str, Any]] = []
        self.localizer = Localizer(
            rig, map, with_settings(config, given.set),
            on_event=lambda t_ns, kind, **fields: self.events.append({"t_ns": t_ns, "kind": kind, **fields}),
        )  # fmt: skip
        self.estimates: list[Estimate] = []
        self.ms: list[float] = []
        for frame in frames:
            start = time.thread_time()
            estimate = self.localizer.feed(Frame(frame.t_ns, frame.images[:1]) if isinstance(frame, Frame) else frame)
            if estimate is not None:
                if estimate.status in ("tracking", "degraded"):
                    self.ms.append(1e3 * (time.thread_time() - start))
                self.estimates.append(estimate)
        self.localizer.close()
        self.earlier = self.localizer.earlier

    def errors(self, T_map_truth: SE3, truth: Trajectory) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Distance in m and angle in degrees of every localized frame to the truth at its time, and its status;
        "earlier" of those that had no pose at the time."""
        off, turn, status = [], [], []
        at_the_time = [(e.t_ns, e.T_world_body, e.status) for e in self.estimates if e.localized]
        for t_ns, T_world_body, name in at_the_time + [(*pose, "earlier") for pose in self.earlier]:
            apart = (T_map_truth @ truth_at(truth, t_ns)).inverse() @ T_world_body
            off.append(float(np.linalg.norm(apart.t)))
            turn.append(float(np.degrees(apart.angle)))
            status.append(name)
        return np.array(off), np.array(turn), status

    def told(self) -> str:
        states = Counter(e.status for e in self.estimates)
        localized = [e.localized for e in self.estimates]
        before = localized.index(True) if any(localized) else len(localized)
        ms, final = np.array(self.ms or [0.0]), np.mean(localized) + len(self.earlier) / len(localized)
        return (
            f"{len(localized)} frames, {np.mean(localized):.1%} localized at the time ({dict(states)}; {before} before "
            f"the first), {final:.1%} in the end, "
            f"CPU ms mean {ms.mean():.1f} p99 {np.percentile(ms, 99):.1f}; "
            f"temporary {self.localizer.stats()['temporary_points']}"
        )


def truth_at(truth: Trajectory, t_ns: int) -> SE3:
    """The true pose at a stamp, between the two around it."""
    i = int(np.clip(np.searchsorted(truth.t_ns, t_ns), 1, len(truth) - 1))
    a, b = int(truth.t_ns[i - 1]), int(truth.t_ns[i])
    return truth.pose(i - 1).interpolate(truth.pose(i), min(max((t_ns - a) / (b - a), 0.0), 1.0))


def T_map_truth_of(path: Trajectory, truth: Trajectory) -> SE3:
    """The map's frame against the truth's, by positions and attitudes of the run that made the map.

    By both: a camera that only turns says nothing of the frame by its positions.
    """
    ours, true = matched(path, truth)
    p, q = ours.xyz - ours.xyz.mean(axis=0), true.xyz - true.xyz.mean(axis=0)
    M = p.T @ q / SIGMA_M**2
    for i in range(len(ours)):
        M += ours.pose(i).R @ true.pose(i).R.T / SIGMA_RAD**2
    U, _, Vt = np.linalg.svd(M)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return SE3(R, ours.xyz.mean(axis=0) - R @ true.xyz.mean(axis=0))


def blocks(given: argparse.Namespace) -> None:
    recording = open_source(given.recording)
    frames = list(recording.messages("rgbd"))
    odd = [(i // given.length) % 2 == 1 for i in range(len(frames))]
    slam = mapped(recording, [f for f, query in zip(frames, odd, strict=True) if not query], "rgbd")
    queries = [f for f, query in zip(frames, odd, strict=True) if query]
    run = Query(recording.rig, slam.map, queries, given)
    print(f"{recording.name}: map of {slam.stats()['keyframes']} keyframes; {run.told()}")
    if given.against_slam:  # where RGB-D SLAM over all frames puts them, both paths laid on one another
        against(run, slam.trajectory(), mapped(recording, frames, "rgbd").trajectory())
    else:
        truth = recording.ground_truth()
        against(run, slam.trajectory(), truth)
        late_ms = clock_offset_ms(slam.trajectory(), truth)
        print(f"with the truth's clock {late_ms:.0f} ms later, where the path of the map itself fits it best:")
        against(run, slam.trajectory(), later(truth, late_ms))
    if given.verbose:
        for e in run.estimates:
            print(e.t_ns, e.status, e.inliers, int(e.details["temporary"]), e.why)
        print(*run.events, sep="\n")


def later(truth: Trajectory, ms: float) -> Trajectory:
    return replace(truth, t_ns=truth.t_ns + round(1e6 * ms))


def clock_offset_ms(path: Trajectory, truth: Trajectory) -> float:
    """By how much the truth's stamps are to be raised for the attitudes of a path to fit it best."""

    def misfit(ms: float) -> float:
        moved = later(truth, ms)
        T = T_map_truth_of(path, moved)
        turns = [(T @ truth_at(moved, int(t))).inverse() @ path.pose(i) for i, t in enumerate(path.t_ns)]
        return float(np.mean([turn.angle**2 for turn in turns]))

    return min(np.arange(-50.0, 51.0, 2.0), key=misfit)


def against(run: Query, path: Trajectory, truth: Trajectory) -> None:
    """Print the errors of a run. path : of the run that made the map, to lay the map's frame on the truth's"""
    off, turn, status = run.errors(T_map_truth_of(path, truth), truth)
    for metres, degrees in ((0.03, 1.0), (0.05, 2.0), (0.10, 2.0), (0.25, 2.0)):
        within = np.count_nonzero((off <= metres) & (turn <= degrees)) / len(run.estimates)
        print(f"  within {metres} m, {degrees} deg: {within:.1%} of all queries")
    tracking = np.array([s == "tracking" for s in status])
    if not len(off):
        return
    print(f"  median {np.median(off):.4f} m {np.median(turn):.3f} deg, largest {off.max():.3f} m {turn.max():.2f} deg")
    print(f"  largest while it says tracking: {off[tracking].max(initial=0.0):.3f} m")


def simulated(given: argparse.Namespace) -> None:
    """Recordings and map are made where they are not there yet; the commands are printed."""
    name = f"{given.building}_{given.seed}"
    recording, run, query, changed = (given.out / f"{name}_{what}" for what in ("map", "run", "query", "changed"))
    rendered = f"sim {given.building} --seed {given.seed} --rate 8 --no-depth --no-lights --threads {given.threads}"
    other = f"{rendered} --path 3 --motion walk --duration {QUERY_S} --cameras 1 --lens equidistant --size 480x360"
    made(recording / "contact_sheet.png", f"{rendered} --motion walk --duration {MAP_S}", recording)
    made(run / "map.lode", f"run {recording} --sensors stereo", run)
    made(query / "contact_sheet.png", other, query)
    made(changed / "contact_sheet.png", f"{other} --changed", changed)
    for where, alone in ((query, False), (changed, False), (changed, True)):
        print("without temporary points:" if alone else "with temporary points:")
        pair(argparse.Namespace(**vars(given) | {
            "run": run, "recording": recording, "query": where, "no_temporary_points": alone,
        }))  # fmt: skip


def made(last: Path, words: str, out: Path) -> None:
    """Run a command of lodelight for what it writes last, unless that is there."""
    if not last.exists():
        print(f"lodelight {words} --out {out}", flush=True)
        subprocess.run([sys.executable, "-m", "lodelight", *words.split(), "--out", str(out)], check=True)


def pair(given: argparse.Namespace) -> None:
    map, T_map_truth = loaded(given)
    query = open_source(given.query)
    if given.gaps_m:
        make_gaps(map, given.gaps_m)
    rig, frames = shrunk(query.rig, query.messages(given.sensors, end_s=given.end), given.scale)
    run = Query(rig, map, frames, given)
    print(f"{query.name} in {given.run}, {len(map.alive_keyframes)} keyframes: {run.told()}")
    off, turn, status = run.errors(T_map_truth, query.ground_truth())
    if len(off):
        print(f"  median {np.median(off):.4f} m {np.median(turn):.3f} deg, p95 {np.percentile(off, 95):.3f} m")
    for name in ("tracking", "degraded", "relocalized", "earlier"):
        some = off[[s == name for s in status]]
        if len(some):
            print(f"  {name}: {len(some)}, median {np.median(some):.4f} m, largest {some.max():.3f} m")
    jumps = [e["jump_m"] for e in run.events if "jump_m" in e]
    print(f"  {len(jumps)} exits with a jump of {np.median(jumps) if jumps else 0.0:.3f} m in the median")
    if given.verbose:
        print(*((e.t_ns, e.status, e.inliers, int(e.details["temporary"]), e.why) for e in run.estimates), sep="\n")
        print(*run.events, sep="\n")


def shrunk(rig, frames, scale: float):
    """The recording of a camera with fewer pixels."""
    if scale == 1.0:
        return rig, frames
    rig = rig.with_cameras(1).resized(scale)
    size = (rig.cameras[0].camera.width, rig.cameras[0].camera.height)
    small = (
        Frame(f.t_ns, (cv2.resize(f.images[0], size, interpolation=cv2.INTER_AREA),)) if isinstance(f, Frame) else f
        for f in frames
    )
    return rig, small


def make_gaps(map: Map, length_m: float) -> None:
    """Take out of a map what is seen mostly from every other stretch of the way: as if all had been replaced there."""
    alive = map.alive_keyframes
    way_m = np.zeros(len(map.keyframes))
    way_m[alive[1:]] = np.cumsum(np.linalg.norm(np.diff(map.keyframes.p[alive], axis=0), axis=1))
    gap = (way_m // length_m).astype(int) % 2 == 1
    gone = [p for p in map.alive_points if gap[map.features.keyframe[map.observations(int(p))]].mean() > 0.5]
    print(f"{len(gone)} of {len(map.alive_points)} points taken out of the map")
    map.remove_points(np.array(gone))


def wrong(given: argparse.Namespace) -> None:
    """Every frame by itself, as a lost camera would ask: global relocalization with the second look."""
    map, T_map_truth = loaded(given)
    for path in [given.query, *given.others]:
        recording = open_source(path)
        right, truth = path == given.query, recording.ground_truth()
        found, far, asked, start = 0, 0, 0, time.process_time()
        for i, frame in enumerate(recording.messages("mono")):
            if i % given.every:
                continue
            estimate = alone(recording.rig, map, given).feed(frame)
            asked += 1
            if estimate.localized:
                found += 1
                true = T_map_truth @ truth_at(truth, frame.t_ns) if right else SE3.identity()
                far += bool(np.linalg.norm(estimate.T_world_body.t - true.t) > 0.5)
        ms = 1e3 * (time.process_time() - start) / max(asked, 1)
        verdict = f", {far} of them over 0.5 m off" if right else " (none may be)"
        print(f"  {recording.name}: {found} of {asked} found{verdict}; CPU {ms:.0f} ms a frame", flush=True)


PLACES: dict[int, Any] = {}


def alone(rig, map: Map, given: argparse.Namespace) -> Localizer:
    """A localizer that has seen nothing yet; the index of places, which is of the map alone, is made once."""
    localizer = Localizer(rig, map, with_settings(LocalizerConfig(), given.set))
    relocalizer = localizer.ladder.relocalizer
    relocalizer.places = PLACES.setdefault(id(map), relocalizer.places)
    return localizer


def kidnap(given: argparse.Namespace) -> None:
    map, T_map_truth = loaded(given)
    query = open_source(given.query)
    frames = [Frame(f.t_ns, f.images[:1]) for f in query.messages("mono")]
    truth, rng = query.ground_truth(), np.random.default_rng(0)
    step_ns = int(np.median(np.diff([f.t_ns for f in frames])))
    black = np.zeros_like(frames[0].images[0])
    took = []
    for _ in range(given.trials):
        before, after = rng.integers(0, len(frames) - 30, 2)
        localizer, t_ns = alone(query.rig, map, given), 0
        for frame in frames[before : before + 5]:
            t_ns += step_ns
            localizer.feed(Frame(t_ns, frame.images))
        for _ in range(10):
            t_ns += 10**9
            assert not localizer.feed(Frame(t_ns, (black,))).localized
        start_ns = t_ns
        for frame in frames[after : after + 30]:
            t_ns += step_ns
            estimate = localizer.feed(Frame(t_ns, frame.images))
            true = T_map_truth @ truth_at(truth, frame.t_ns)
            if estimate.localized and np.linalg.norm(estimate.T_world_body.t - true.t) <= 0.05:
                took.append((t_ns - start_ns) * 1e-9)
                break
    within = sum(t_s <= 1.0 for t_s in took)
    print(
        f"{within} of {given.trials} back within 1 s and 5 cm; took {np.median(took):.3f} s, at most {max(took):.3f} s"
    )


def speed(given: argparse.Namespace) -> None:
    """A map of every other frame, each a keyframe at its true pose with the points of its own depths, and the same
    again 100 m away until there are enough: relocalization has the most rivals there."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from lodelight.localization.relocalize import Relocalizer
    from single_frames import ORB, map_of, shots

    recording = open_source(given.query)
    taken = shots(recording, "rgbd", 2)
    copies = -(-given.keyframes // len(taken))
    moved = [
        replace(shot, T_world_cam=SE3(shot.T_world_cam.R, shot.T_world_cam.t + np.array([100.0 * k, 0.0, 0.0])))
        for k in range(copies)
        for shot in taken
    ]
    map = map_of(moved[: given.keyframes], recording.rig.cameras[0].camera)
    relocalizer = Relocalizer(map, ORB)
    relocalizer.find(taken[0].seen)
    ms = []
    for shot in taken[1::7]:
        start = time.process_time()
        relocalizer.find(shot.seen)
        ms.append(1e3 * (time.process_time() - start))
    print(f"{len(map.keyframes)} keyframes, {len(ms)} queries: ms median {np.median(ms):.0f}, largest {max(ms):.0f}")


def memory(given: argparse.Namespace) -> None:
    """There and back again through the recording, so that the camera never jumps."""
    map = load_map(given.run / "map.lode")
    query = open_source(given.query)
    rig, small = shrunk(query.rig, query.messages("mono", given.start, given.end), given.scale)
    frames = [Frame(f.t_ns, f.images[:1]) for f in small]
    step_ns = int(np.median(np.diff([f.t_ns for f in frames])))
    localizer = Localizer(rig, map, with_settings(LocalizerConfig(), given.set))
    there_and_back = [*frames, *frames[-2:0:-1]]
    per_minute = round(60e9 / step_ns)
    for i in range(given.minutes * per_minute + 1):
        localizer.feed(Frame(i * step_ns, there_and_back[i % len(there_and_back)].images))
        if i % per_minute == 0:
            print(f"minute {i // per_minute}: {resident_bytes() / 1e6:.1f} MB resident", flush=True)


def loaded(given: argparse.Namespace) -> tuple[Map, SE3]:
    """The map of a run, and T_map_truth by its path and the truth of what it was made from."""
    truth = open_source(given.recording).ground_truth()
    return load_map(given.run / "map.lode"), T_map_truth_of(read_trajectory(given.run / "trajectory.tum"), truth)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tasks = arguments.add_subparsers(required=True)

    def task(name, work, *recordings):
        parser = tasks.add_parser(name)
        for recording in recordings:
            parser.add_argument(recording, type=Path)
        parser.add_argument("--set", action="append", default=[], help="a setting of the localizer")
        parser.add_argument("--no-temporary-points", action="store_true")
        parser.add_argument("--sensors", choices=["mono", "mono-inertial"], default="mono", help="of the query")
        parser.add_argument("--verbose", action="store_true")
        parser.set_defaults(work=work)
        return parser

    parser = task("blocks", blocks, "recording")
    parser.add_argument("--length", type=int, default=30)
    parser.add_argument("--against-slam", action="store_true", help="not the truth, but SLAM over all frames")
    for parser in (task("pair", pair, "run", "recording", "query"), task("simulated", simulated)):
        parser.add_argument("--end", type=float, default=float("inf"))
        parser.add_argument("--scale", type=float, default=1.0, help="of the query's images")
        parser.add_argument("--gaps-m", type=float, default=0.0, help="take every other stretch so long out of the map")
    parser.add_argument("building", choices=["office", "warehouse"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("simulated"), help="folder for recordings and maps")
    parser.add_argument("--threads", type=int, default=2, help="images rendered at a time")
    parser = task("wrong", wrong, "run", "recording", "query")
    parser.add_argument("others", type=Path, nargs="*")
    parser.add_argument("--every", type=int, default=1)
    task("kidnap", kidnap, "run", "recording", "query").add_argument("--trials", type=int, default=50)
    task("speed", speed, "query").add_argument("--keyframes", type=int, default=1000)
    parser = task("memory", memory, "run", "query")
    parser.add_argument("--minutes", type=int, default=30)
    parser.add_argument("--start", type=float, default=0.0)
    parser.add_argument("--end", type=float, default=float("inf"))
    parser.add_argument("--scale", type=float, default=1.0, help="of the query's images")
    given = arguments.parse_args()
    cv2.setNumThreads(1)
    given.work(given)


if __name__ == "__main__":
    main()
