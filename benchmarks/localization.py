"""Localization in a saved map, measured: `python benchmarks/localization.py TASK ...`

blocks RECORDING --length 30    map from even blocks of a recording with depth, queries from odd ones,
                                colour alone
"""

from __future__ import annotations

import argparse
import os
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
from lodelight.localizer import Localizer, LocalizerConfig
from lodelight.mapping.map import Map
from lodelight.messages import Estimate, Frame
from lodelight.settings import with_settings
from lodelight.slam import Slam, SlamConfig
from lodelight.trajectory import Trajectory

SIGMA_M, SIGMA_RAD = 0.02, 0.02  # errors of a run: how positions and attitudes weigh when frames are laid together


def mapped(recording, frames: list[Frame], sensors: str) -> Slam:
    """SLAM over some frames of a recording."""
    slam = Slam(recording.rig, SlamConfig(sensors=sensors))
    for frame in frames:
        slam.feed(frame)
    slam.close()
    return slam


class Query:
    """Frames through a localizer: estimates, and CPU ms of each."""

    def __init__(self, rig, map: Map, frames: Any, given: argparse.Namespace) -> None:
        config = LocalizerConfig(sensors="mono", temporary_points=not given.no_temporary_points)
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
                self.ms.append(1e3 * (time.thread_time() - start))
                self.estimates.append(estimate)
        self.localizer.close()

    def errors(self, T_map_truth: SE3, truth: Trajectory) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Distance in m and angle in degrees of every localized frame to the truth nearest in time, and its status."""
        off, turn, status = [], [], []
        for e in self.estimates:
            if e.localized:
                apart = (T_map_truth @ truth_at(truth, e.t_ns)).inverse() @ e.T_world_body
                off.append(float(np.linalg.norm(apart.t)))
                turn.append(float(np.degrees(apart.angle)))
                status.append(e.status)
        return np.array(off), np.array(turn), status

    def told(self) -> str:
        states = Counter(e.status for e in self.estimates)
        localized = np.mean([e.localized for e in self.estimates])
        ms = np.array(self.ms)
        return (
            f"{len(self.estimates)} frames, {localized:.1%} localized ({dict(states)}), "
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
    truth = recording.ground_truth()
    truth = replace(truth, t_ns=truth.t_ns + round(1e6 * given.truth_late_ms))
    T_map_truth = T_map_truth_of(slam.trajectory(), truth)
    if given.against_slam:  # where RGB-D SLAM over all frames puts them, both paths laid on one another
        whole = mapped(recording, frames, "rgbd")
        truth = whole.trajectory()
        T_map_truth = T_map_truth_of(slam.trajectory(), truth)
    run = Query(recording.rig, slam.map, queries, given)
    print(f"{recording.name}: map of {slam.stats()['keyframes']} keyframes; {run.told()}")
    off, turn, status = run.errors(T_map_truth, truth)
    for metres, degrees in ((0.03, 1.0), (0.05, 2.0), (0.10, 2.0), (0.25, 2.0)):
        within = np.count_nonzero((off <= metres) & (turn <= degrees)) / len(run.estimates)
        print(f"  within {metres} m, {degrees} deg: {within:.1%} of all queries")
    tracking = np.array([s == "tracking" for s in status])
    print(f"  median {np.median(off):.4f} m {np.median(turn):.3f} deg, largest {off.max():.3f} m {turn.max():.2f} deg")
    print(f"  largest while it says tracking: {off[tracking].max(initial=0.0):.3f} m")
    if given.verbose:
        for e in run.estimates:
            print(e.t_ns, e.status, e.inliers, int(e.details["temporary"]), e.why)
        print(*run.events, sep="\n")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tasks = arguments.add_subparsers(required=True)

    def task(name, work, *recordings):
        parser = tasks.add_parser(name)
        for recording in recordings:
            parser.add_argument(recording, type=Path)
        parser.add_argument("--set", action="append", default=[], help="a setting of the localizer")
        parser.add_argument("--no-temporary-points", action="store_true")
        parser.add_argument("--verbose", action="store_true")
        parser.set_defaults(work=work)
        return parser

    parser = task("blocks", blocks, "recording")
    parser.add_argument("--length", type=int, default=30)
    parser.add_argument("--against-slam", action="store_true", help="not the truth, but SLAM over all frames")
    parser.add_argument("--truth-late-ms", type=float, default=0.0, help="clock of the truth, against the images'")
    given = arguments.parse_args()
    cv2.setNumThreads(1)
    given.work(given)


if __name__ == "__main__":
    main()
