"""Consistency and time of the visual-inertial window on simulated features: `python benchmarks/window.py [--seeds 50]`.

NEES per degree of freedom of the newest state over many seeds (1 = the covariances say the truth), errors, and the
processor time of a frame and of an iteration. A walk through a room of 12 x 9 m, frames at 10 Hz, 1 px noise.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import platform
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from inertial_scenes import fly, nees, scene
from lodelight.estimation.window import WindowConfig
from lodelight.estimation.window_problem import Problem

CASES = {
    "mono": (1, "none"),
    "mono, surveyed tags": (1, "known"),
    "mono, unknown tags": (1, "estimated"),
    "stereo": (2, "none"),
    "stereo, surveyed tags": (2, "known"),
}


def consistency(seeds: int, duration_s: float, only: str | None) -> None:
    print(
        "\n| sensors | NEES pose | rotation | position | velocity | biases | by thirds | sd of a seed | RMSE mm | deg |"
    )
    print("| --- " * 10 + "|")
    for name, (cameras, tags) in CASES.items():
        if only not in (None, name):
            continue
        flights = []
        for seed in range(seeds):
            made = scene(
                seed,
                duration_s=duration_s,
                rate_hz=10.0,
                cameras=cameras,
                tags=0 if tags == "none" else 10,
                max_tracks=100,
            )
            flights.append(fly(made, WindowConfig(), tags, covariance_every=5))
        parts = (slice(0, 6), slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 15))
        means = [np.mean([nees(f.errors, f.covariances, p).mean() for f in flights]) for p in parts]
        whole = np.array([nees(f.errors, f.covariances, parts[0]) for f in flights])
        thirds = " ".join(f"{part.mean():.2f}" for part in np.array_split(whole, 3, axis=1))
        errors = np.array([f.errors for f in flights])
        rmse = 1e3 * np.sqrt((errors[..., 3:6] ** 2).sum(-1).mean())
        turn = np.degrees(np.sqrt((errors[..., :3] ** 2).sum(-1).mean()))
        cells = [
            name,
            *(f"{m:.2f}" for m in means),
            thirds,
            f"{whole.mean(axis=1).std():.2f}",
            f"{rmse:.0f}",
            f"{turn:.2f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


def speed() -> None:
    """150 tracks a frame at 20 Hz, as a real front end has them."""
    print("\n| sensors | observations | steps | ms a frame | p99 | ms an iteration |")
    print("| --- " * 6 + "|")
    spent: list[float] = []
    for cameras in (1, 2):
        fly(scene(0, duration_s=2.0, cameras=cameras, max_tracks=150))  # compiles
        linearize, step = Problem.linearize, Problem._step

        def timed(work, at=spent):  # type: ignore[no-untyped-def]
            def measured(*a, **k):  # type: ignore[no-untyped-def]
                began = time.thread_time()
                out = work(*a, **k)
                at.append(1e3 * (time.thread_time() - began))
                return out

            return measured

        lin_ms: list[float] = []
        step_ms: list[float] = []
        Problem.linearize, Problem._step = timed(linearize, lin_ms), timed(step, step_ms)  # type: ignore[method-assign]
        flight = fly(scene(0, duration_s=15.0, cameras=cameras, max_tracks=150))
        Problem.linearize, Problem._step = linearize, step  # type: ignore[method-assign]
        observations = np.mean([len(f.seen) for f in flight.window.frames]) * len(flight.window.frames)
        cells = (
            "stereo" if cameras == 2 else "mono", f"{observations:.0f}", f"{len(step_ms) / len(flight.ms):.1f}",
            f"{flight.ms.mean():.1f}", f"{np.percentile(flight.ms, 99):.1f}",
            f"{np.median(lin_ms) + np.median(step_ms):.2f}",
        )  # fmt: skip
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seeds", type=int, default=50)
    arguments.add_argument("--duration", type=float, default=10.0, help="seconds of each flight")
    arguments.add_argument("--only", choices=CASES, help="one of the cases, without times")
    options = arguments.parse_args()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}")
    if options.only is None:
        speed()
    consistency(options.seeds, options.duration, options.only)
