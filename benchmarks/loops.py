"""Place recognition and verification of pairs, on recordings with truth: `python benchmarks/loops.py RECORDING ...`

Every so manyeth frame of every recording (RGB-D, or stereo) stands alone, with the points of its own depths, in one
map. Pairs of different recordings, and pairs of one whose views have nothing in common by depth and truth, must be
refused; pairs that share a view should be verified, at the true relative pose. Prints docs/places-and-loops.md's
tables. Recordings must be of different places.
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from lodelight.geometry.cameras import Camera
from lodelight.io.sources import open_source
from lodelight.mapping.pairs import Pair, PairConfig, verify_pair
from lodelight.mapping.places import Places
from lodelight.mapping.verification import Verifier
from single_frames import ORB, Shot, map_of, shots

SIGMA_PX = 0.8
BINS = (0.2, 0.35, 0.5, 0.7, 1.0)


def overlaps(taken: list[Shot], camera: Camera) -> np.ndarray:
    """(N, N) share of the view that two frames have in common, the lesser way round; by depth, with occlusion."""
    step = 16
    u, v = np.meshgrid(np.arange(step // 2, camera.width, step), np.arange(step // 2, camera.height, step))
    px = np.stack([u.ravel(), v.ravel()], axis=1)
    ray, _ = camera.unproject(px.astype(float))
    ray /= ray[:, 2:]
    out = np.zeros((len(taken), len(taken)))
    for a, here in enumerate(taken):
        z = here.frame.depth[px[:, 1], px[:, 0]]
        X = here.T_world_cam @ (ray[z > 0] * z[z > 0, None])
        for b, there in enumerate(taken):
            Y = there.T_world_cam.inverse() @ X
            at, seen = camera.project(Y)
            column, row = np.rint(at[seen]).astype(int).clip(0, (camera.width - 1, camera.height - 1)).T
            depth = there.frame.depth[row, column]
            visible = (depth == 0) | (np.abs(depth - Y[seen, 2]) < 0.05 + 0.1 * depth)
            out[a, b] = visible.sum() / max(len(X), 1)
    return np.minimum(out, out.T)


class Trial:
    """All frames of all recordings in one map, and what is true of every pair of them."""

    def __init__(self, paths: list[Path], every: int) -> None:
        taken: list[Shot] = []
        self.room = np.zeros(0, int)
        self.names = [path.name for path in paths]
        blocks = []
        for i, path in enumerate(paths):
            recording = open_source(path)
            sensors = recording.rig.sensors.removesuffix("-inertial")
            some = shots(recording, sensors, every)
            blocks.append(overlaps(some, recording.rig.cameras[0].camera) if sensors == "rgbd" else None)
            taken += [shot.idealized for shot in some]
            self.room = np.append(self.room, np.full(len(some), i))
        self.overlap = np.full((len(taken), len(taken)), 0.0)
        self.near = np.eye(len(taken), dtype=bool)  # too near in time to ask about
        for i, block in enumerate(blocks):
            rows = np.flatnonzero(self.room == i)
            apart = np.abs(rows[:, None] - rows[None, :])
            self.near[np.ix_(rows, rows)] = (apart * every < 30) | (block is None)
            if block is not None:
                self.overlap[np.ix_(rows, rows)] = block
        self.map = map_of(taken)
        self.verifier = Verifier(self.map, ORB, SIGMA_PX)

    def pairs(self, low: float, high: float) -> np.ndarray:
        """(M, 2) pairs a != b with low < overlap <= high."""
        return np.argwhere((self.overlap > low) & (self.overlap <= high) & ~self.near)


def wrong_pairs(trial: Trial, config: PairConfig, count: int, rng: np.random.Generator) -> None:
    """Everything that agrees on a pose by chance, however little, is counted."""
    pairs = trial.pairs(-1.0, 0.0)
    pairs = pairs[rng.permutation(len(pairs))[:count]]
    accepted, inliers, other_room = 0, Counter(), 0
    start = time.process_time()
    for a, b in pairs.tolist():
        answer = verify_pair(trial.verifier, a, b, config)
        accepted += isinstance(answer, Pair)
        inliers[answer.inliers] += 1
        other_room += trial.room[a] != trial.room[b]
        if isinstance(answer, Pair):
            print(f"ACCEPTED: {a} {b} of {trial.names[trial.room[a]]}, {trial.names[trial.room[b]]}")
    ms = 1e3 * (time.process_time() - start) / len(pairs)
    print(
        f"\nwrong pairs: {len(pairs)}, of them in different recordings {other_room}; accepted {accepted}; {ms:.1f} ms"
    )
    print(
        "most points or matches that agreed on a pose: " + ", ".join(f"{n}: {inliers[n]}" for n in sorted(inliers)[-8:])
    )


def right_pairs(trial: Trial, config: PairConfig, count: int, rng: np.random.Generator) -> None:
    print(
        "\n| recording | overlap | pairs | verified | off, median | off, largest | ms |\n|---|---|---|---|---|---|---|"
    )
    for i, name in enumerate(trial.names):
        for low, high in itertools.pairwise(BINS):
            pairs = trial.pairs(low, high)
            pairs = pairs[trial.room[pairs[:, 0]] == i]
            if len(pairs) == 0:
                continue
            pairs = pairs[rng.permutation(len(pairs))[:count]]
            start, off = time.process_time(), []
            for a, b in pairs.tolist():
                answer = verify_pair(trial.verifier, a, b, config)
                if isinstance(answer, Pair):
                    error = (trial.map.pose(a).inverse() @ trial.map.pose(b)).inverse() @ answer.T_a_b
                    off.append((float(np.linalg.norm(error.t)), float(np.degrees(error.angle))))
            ms = 1e3 * (time.process_time() - start) / len(pairs)
            median, worst = (np.median(off, axis=0), np.max(off, axis=0)) if off else (np.full(2, np.nan),) * 2
            print(
                f"| {name} | {low} to {high} | {len(pairs)} | {len(off) / len(pairs):.0%} | {median[0]:.3f} m "
                f"{median[1]:.2f}° | {worst[0]:.3f} m {worst[1]:.2f}° | {ms:.1f} |"
            )


def retrieval(trial: Trial) -> None:
    """Of the frames most alike, among all of all recordings, how many share the view."""
    places = Places(trial.map)
    print(
        "\n| recording | frames with 3 others of their view | first is one | share of the best 5 | ms |\n"
        "|---|---|---|---|---|"
    )
    for i, name in enumerate(trial.names):
        first, best, ms = [], [], []
        for a in np.flatnonzero(trial.room == i).tolist():
            shared = (trial.overlap[a] > 0.5) & ~trial.near[a]
            if shared.sum() < 3:
                continue
            start = time.process_time()
            score, _ = places.similarity(trial.map.features.desc[trial.map.feature_range(a)])
            ms.append(1e3 * (time.process_time() - start))
            unclear = trial.near[a] | ((trial.overlap[a] > 0.2) & ~shared)
            order = np.argsort(-np.where(unclear, -1.0, score), kind="stable")
            first.append(shared[order[0]])
            best.append(shared[order[: min(5, shared.sum())]].mean())
        if first:
            print(f"| {name} | {len(first)} | {np.mean(first):.0%} | {np.mean(best):.0%} | {np.median(ms):.1f} |")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("recordings", nargs="+", type=Path)
    arguments.add_argument("--every", type=int, default=5, help="frames from one that is taken to the next")
    arguments.add_argument("--wrong", type=int, default=10_000)
    arguments.add_argument("--min-inliers", type=int, default=PairConfig.min_inliers)
    arguments.add_argument("--min-coverage", type=float, default=PairConfig.min_coverage)
    arguments.add_argument("--right", type=int, default=300, help="pairs for each recording and bin of overlap")
    given = arguments.parse_args()
    trial = Trial(given.recordings, given.every)
    print(f"{platform.machine()}, Python {platform.python_version()}; {len(trial.room)} frames")
    retrieval(trial)
    config = PairConfig(given.min_inliers, given.min_coverage)
    right_pairs(trial, config, given.right, np.random.default_rng(0))
    wrong_pairs(trial, config, given.wrong, np.random.default_rng(1))


if __name__ == "__main__":
    main()
