"""A made-up run, for the tests of outputs and report: a walk through a room, with a loss and a relocalization."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lodelight.anchors import Tag
from lodelight.geometry.se3 import SE3
from lodelight.messages import Estimate
from lodelight.report.outputs import Outputs
from lodelight.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000


def room_points(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) m on the walls, floor and ceiling of a room of 8 x 6 x 2.8 m, and some far strays."""
    xyz = rng.uniform([-4, -3, 0], [4, 3, 2.8], (count, 3))
    wall = rng.integers(0, 5, count)
    for side, (axis, value) in enumerate([(0, -4), (0, 4), (1, -3), (1, 3), (2, 0)]):
        xyz[wall == side, axis] = value + rng.normal(0, 0.02, (wall == side).sum())
    xyz[: count // 200] *= 20
    return xyz


def walk(frames: int) -> Trajectory:
    """The true path: rounds of the room at 30 Hz."""
    t_s = np.arange(frames) / 30
    turn = 2 * np.pi * t_s / max(t_s[-1], 1) * max(1, round(frames / 900))
    xyz = np.stack([2.8 * np.cos(turn), 1.9 * np.sin(turn), 1.4 + 0.05 * np.sin(9 * turn)], axis=1)
    tilt = np.stack([0.05 * np.sin(3 * turn), 0.05 * np.cos(2 * turn), turn], axis=1)
    t_ns = START_NS + np.round(t_s * 1e9).astype(np.int64)
    poses = [SE3.exp(np.concatenate(pair)) for pair in zip(tilt, xyz, strict=True)]
    return Trajectory.from_poses(t_ns.tolist(), poses)


def make_run(
    out: Path,
    frames: int = 300,
    points: int = 2000,
    truth: bool = True,
    seed: int = 0,
    slow_ms: float = 1.0,
    tag: bool = False,
) -> dict[str, Any]:
    """Write an out folder of a 30 Hz run and return its metrics; slow_ms scales the made-up timings."""
    rng = np.random.default_rng(seed)
    true = walk(frames)
    t_ns = true.t_ns.tolist()
    recording_s = (t_ns[-1] - t_ns[0]) / 1e9
    drift = np.cumsum(rng.normal(0, 0.004, (frames, 6)), axis=0) * np.sin(np.linspace(0, np.pi, frames))[:, None]
    world = SE3.exp(np.array([0.1, -0.2, 0.7, 1.0, 2.0, 0.3]))
    lost = slice(frames // 2, frames // 2 + max(frames // 20, 1))

    axes = [f"{kind}_{axis}" for kind in ("bias_gyro", "bias_accel") for axis in "xyz"]
    motion = dict.fromkeys(axes, 0.01) | {f"sigma_{name}": 0.001 for name in axes}
    motion |= {f"velocity_{axis}": 0.5 for axis in "xyz"}
    final = []
    with Outputs(out, {"seed": seed, "source": "made-up room", "slam": {"window": 10, "resume": None}}) as outputs:
        for i in range(frames):
            status = "initializing" if i == 0 else "lost" if lost.start <= i < lost.stop else "tracking"
            status = "relocalized" if i == lost.stop else "degraded" if lost.start - 8 <= i < lost.start else status
            pose = world @ true.pose(i).perturbed(0.3 * drift[i])
            sigma = 0.002 + 0.00002 * i
            covariance = np.diag([*[(0.3 * sigma) ** 2] * 3, *[sigma**2] * 3])
            why = f"{rng.integers(3, 12)} of 120 tracks survived" if status == "lost" else ""
            keyframe = i % 12 == 0 and status == "tracking"
            outputs.frame(
                Estimate(t_ns[i], status, pose, covariance, why, int(rng.normal(220, 25)) if status != "lost" else 5),
                track_ms=slow_ms * (14 + rng.gamma(2, 2.0)),
                map_ms=slow_ms * (30 + rng.gamma(3, 8.0)) if keyframe else 0.0,
                **motion,
            )
            if status == "tracking":
                reason = "0.71 of the reference keyframe's points seen" if keyframe else "enough overlap"
                outputs.event(t_ns[i], "keyframe", inserted=keyframe, why=reason, weight=np.float64(0.9))
            if status == "relocalized":
                outputs.event(t_ns[i], "relocalization", candidates=np.int64(4), inliers=87, keyframe=3)
            if status != "lost":
                final.append((t_ns[i], world @ true.pose(i).perturbed(0.1 * drift[i])))
        return outputs.finish(
            Trajectory.from_poses([t for t, _ in final], [T for _, T in final]),
            world @ room_points(points, rng),
            {"keyframes": frames // 12, "map_points": points, "loops": 1, "relocalizations": 1},
            true if truth else None,
            wall_s=0.62 * recording_s + 4.2,
            compile_s=4.2,
            recording_s=recording_s,
            tags=[Tag("qr", "T07", 0.2, world @ SE3(np.eye(3), np.array([1.0, 2.9, 1.4])))] if tag else [],
        )
