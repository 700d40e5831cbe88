"""Any readable recording, trajectory or rig to a writable one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from lodelight.errors import SourceError
from lodelight.io import rosbag
from lodelight.io.calibrations import load_rig
from lodelight.io.clouds import read_ply
from lodelight.io.euroc_writer import TRUTH, append_image, append_imu, stored_depth, write_sensors
from lodelight.io.recording import Recording
from lodelight.io.rig_toml import write_rig
from lodelight.io.rosbag_convert import (
    write_cloud_bag,
    write_out_folder_bag,
    write_recording_bag,
    write_trajectory_bag,
)
from lodelight.io.rosbag_poses import read_poses
from lodelight.io.rosbag_writer import SUFFIXES as BAGS
from lodelight.io.sources import is_recording, open_source
from lodelight.io.trajectories import WRITERS, read_trajectory, write_euroc, write_trajectory
from lodelight.messages import Frame, Imu
from lodelight.rig import Rig
from lodelight.trajectory import Trajectory

Progress = Callable[[Iterator[Frame], int], Iterator[Frame]]


def convert(
    source: str | Path,
    dest: str | Path,
    rig: str | Path | None = None,
    start_s: float = 0.0,
    end_s: float = math.inf,
    progress: Progress = lambda frames, n: frames,
    topics: Mapping[str, str] | None = None,
) -> Recording | None:
    """Write `source` as what the name of `dest` ends in.

    `.tum`, `.txt`, `.csv`, `.kitti`: a trajectory, of a file or the truth of a recording; `.toml`: a rig, of a
    calibration file or of a recording; `.bag`, `.mcap`, `.db3`: a ROS bag of a recording, a trajectory, a PLY cloud or
    an out folder; else an EuRoC folder of a recording, which is returned with what it skipped.
    topics : of a ROS bag as source, by role; progress : wraps the frames and their number
    """
    source, dest = Path(source), Path(dest)
    suffix = dest.suffix.lower()
    if suffix in WRITERS:
        write_trajectory(dest, _trajectory(source, rig, topics))
        return None
    if suffix == ".toml":
        calibration = source.is_file() and rig is None and not is_recording(source)
        write_rig(dest, load_rig(source) if calibration else open_source(source, rig, topics).rig)
        return None
    if suffix in BAGS and not is_recording(source):
        _to_bag(source, dest)
        return None
    recording = open_source(source, rig, topics)
    if suffix in BAGS:
        write_recording_bag(recording, dest, start_s, end_s, progress)
    else:
        write_recording(recording, dest, start_s, end_s, progress)
    return recording


def _trajectory(source: Path, rig: str | Path | None, topics: Mapping[str, str] | None) -> Trajectory:
    """Of a file, of a bag's poses, or the truth of a recording."""
    if rosbag.recognize(source):
        return read_poses(source, (topics or {}).get("truth"))
    truth = read_trajectory(source) if source.is_file() else open_source(source, rig).ground_truth()
    if truth is None:
        raise SourceError(f"{source} has no ground truth to convert")
    return truth


def _to_bag(source: Path, dest: Path) -> None:
    if source.is_dir() and (source / "trajectory.tum").is_file():
        write_out_folder_bag(source, dest)
    elif source.suffix.lower() == ".ply":
        write_cloud_bag(dest, read_ply(source))
    elif source.is_file():
        write_trajectory_bag(dest, read_trajectory(source))
    else:
        open_source(source)  # says what is wrong with it


def write_recording(
    recording: Recording,
    root: Path,
    start_s: float = 0.0,
    end_s: float = math.inf,
    progress: Progress = lambda frames, n: frames,
) -> None:
    """An EuRoC folder with all cameras, depth registered to camera 0, light camera, IMU and truth of a recording.

    Stamps go onto the body's clock, so that the time offsets of the written rig are 0.
    """
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise SourceError(f"{root} exists already; remove it or choose another name")
    rig = _written_rig(recording.rig)
    folders = write_sensors(root, rig, comment=f"{recording.name}, {recording.format}")
    names = [f"cam{i}" for i in range(len(rig.cameras))]
    frames = recording.frames(len(rig.cameras), rig.depth is not None, start_s, end_s)
    lights = recording.light_frames(start_s, end_s) if rig.lights is not None else None
    with closing(frames):
        for frame in progress(frames, recording.n_frames):
            for name, image in zip(names, frame.images, strict=True):
                append_image(folders[name], frame.t_ns, image)
            if rig.depth is not None and frame.depth is not None:
                append_image(folders["depth0"], frame.t_ns, stored_depth(frame.depth, rig.depth))
    if lights is not None:
        with closing(lights):
            for frame in lights:
                append_image(folders["light0"], frame.t_ns, frame.images[0])
    if rig.imu is not None:
        _append_samples(folders["imu0"], recording.inertial(start_s, end_s))
    truth = recording.ground_truth()
    if truth is not None:
        write_euroc(folders[TRUTH] / "data.csv", truth)


def _written_rig(rig: Rig) -> Rig:
    cameras = tuple(replace(spec, time_offset_s=0.0) for spec in rig.cameras)
    depth = rig.depth
    if depth is not None:
        depth = replace(depth, camera=cameras[0].camera, T_body_depth=cameras[0].T_body_cam, registered=True)
    imu = replace(rig.imu, time_offset_s=0.0) if rig.imu else None
    return Rig(cameras, depth=depth, imu=imu, lights=replace(rig.lights, time_offset_s=0.0) if rig.lights else None)


def _append_samples(folder: Path, samples: Iterator[Imu]) -> None:
    listed = list(samples)
    gyro = np.array([sample.gyro for sample in listed]).reshape(-1, 3)
    accel = np.array([sample.accel for sample in listed]).reshape(-1, 3)
    append_imu(folder, np.array([sample.t_ns for sample in listed], dtype=np.int64), gyro, accel)
