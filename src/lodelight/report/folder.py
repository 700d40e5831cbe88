"""An out folder read back: what the report draws."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData

from lodelight.anchors import Tag
from lodelight.errors import SourceError
from lodelight.evaluation.align import Alignment, Mode, align
from lodelight.evaluation.associate import matched
from lodelight.evaluation.ate import pose_errors
from lodelight.evaluation.nees import nees_of
from lodelight.evaluation.rpe import travelled_m
from lodelight.io.anchors_toml import read_anchors
from lodelight.io.covariances import read_covariances
from lodelight.io.trajectories import read_trajectory
from lodelight.trajectory import Trajectory
from lodelight.types import Array, ArrayF32


@dataclass(frozen=True, eq=False)
class Errors:
    """Error of each matched pose after alignment: stamps (N,) ns, position m, rotation deg, path so far m."""

    t_ns: NDArray[np.int64]
    position_m: Array
    rotation_deg: Array
    along_m: Array


@dataclass(frozen=True, eq=False)
class Path3D:
    """A trajectory in the frame that is drawn: the truth's where there is one. `errors` is None without truth."""

    poses: Trajectory
    alignment: Alignment | None
    errors: Errors | None


@dataclass(frozen=True, eq=False)
class Consistency:
    """Squared error of each live pose, after alignment, over its covariance, per degree of freedom: t_ns, nees (N,)."""

    t_ns: NDArray[np.int64]
    nees: Array


@dataclass(frozen=True, eq=False)
class RunFolder:
    """frames : columns of `frames.csv`, times in s since the first; events : lines of `events.jsonl`

    tags : as they were found; nees : None where there is no truth, or no covariance
    """

    name: str
    metrics: dict[str, Any]
    frames: dict[str, list[str]]
    events: list[dict[str, Any]]
    final: Path3D
    live: Path3D
    truth: Trajectory | None
    cloud_xyz: ArrayF32
    tags: tuple[Tag, ...]
    nees: Consistency | None
    sigma_t_ns: NDArray[np.int64]
    sigma_m: Array
    sigma_deg: Array

    def column(self, name: str) -> tuple[Array, Array] | None:
        """Seconds (N,) and values (N,) of the frames that have something in a further column; None where none has."""
        cells = self.frames.get(name, [])
        rows = [i for i, cell in enumerate(cells) if cell]
        if not rows:
            return None
        t_ns = np.array([int(self.frames["t_ns"][i]) for i in rows], dtype=np.int64)
        return self.seconds(t_ns), np.array([float(cells[i]) for i in rows])

    def seconds(self, t_ns: NDArray[np.int64]) -> Array:
        """Stamps as seconds since the first frame."""
        start = int(self.frames["t_ns"][0]) if self.frames["t_ns"] else 0
        return (t_ns - start) / 1e9


def read_folder(out: Path, truth: Trajectory | None, mode: Mode) -> RunFolder:
    """Raises SourceError where a file of the folder is missing or not what it should be."""
    try:
        metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        events = [json.loads(line) for line in (out / "events.jsonl").read_text(encoding="utf-8").splitlines()]
        with (out / "frames.csv").open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            frames = {name: [row[name] for row in rows] for name in reader.fieldnames or ()}
        vertex = PlyData.read(str(out / "cloud.ply"))["vertex"]
        cloud = np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1).astype(np.float32)
    except (OSError, ValueError, KeyError) as error:
        raise SourceError(f"{out} is no complete out folder ({error}); run again") from None
    t_ns, covariances = read_covariances(out / "covariance.csv")
    variances = np.einsum("nii->ni", covariances)
    told = _poses(out / "trajectory_live.tum")
    if mode == "none":  # before it lay in the world it was in another frame
        told = told.rows(np.isin(told.t_ns, _stamps_of_aligned(frames)))
    live = _placed(told, truth, mode)
    return RunFolder(
        name=out.resolve().name,
        metrics=metrics,
        frames=frames,
        events=events,
        final=_placed(_poses(out / "trajectory.tum"), truth, mode),
        live=live,
        truth=truth,
        cloud_xyz=cloud[np.isfinite(cloud).all(axis=1)],
        tags=read_anchors(out / "anchors.toml").tags,
        nees=_consistency(live, truth, t_ns, covariances),
        sigma_t_ns=t_ns,
        sigma_m=np.sqrt(variances[:, 3:].sum(axis=1)),
        sigma_deg=np.rad2deg(np.sqrt(variances[:, :3].sum(axis=1))),
    )


def _stamps_of_aligned(frames: dict[str, list[str]]) -> NDArray[np.int64]:
    """Of the frames whose pose was one in the world; of all where that was not asked."""
    aligned = frames.get("aligned", ["1"] * len(frames["t_ns"]))
    stamps = [int(t) for t, cell in zip(frames["t_ns"], aligned, strict=True) if cell and float(cell)]
    return np.array(stamps, np.int64)


def _poses(path: Path) -> Trajectory:
    if not any(not line.startswith("#") for line in path.read_text(encoding="utf-8").splitlines()):
        return Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
    return read_trajectory(path)


def _placed(poses: Trajectory, truth: Trajectory | None, mode: Mode) -> Path3D:
    try:
        if truth is None:
            raise SourceError("no ground truth")
        ours, true = matched(poses, truth)
        alignment = align(ours, true, mode)
    except SourceError:
        return Path3D(poses, None, None)
    distance, angle = pose_errors(alignment.apply(ours), true)
    errors = Errors(ours.t_ns, distance, np.rad2deg(angle), travelled_m(true))
    return Path3D(alignment.apply(poses), alignment, errors)


def _consistency(
    live: Path3D, truth: Trajectory | None, t_ns: NDArray[np.int64], covariance: Array
) -> Consistency | None:
    if truth is None or live.alignment is None:
        return None
    ours, true = matched(live.poses, truth)
    stamps, pose, row = np.intersect1d(ours.t_ns, t_ns, return_indices=True)
    turn = np.eye(6)
    turn[3:, 3:] = live.alignment.scale * live.alignment.R
    return Consistency(stamps, nees_of(ours.rows(pose), true.rows(pose), turn @ covariance[row] @ turn.T))
