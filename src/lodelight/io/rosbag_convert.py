"""Recordings, trajectories, clouds and out folders to bags.

A recording's bag holds its rig twice: as CameraInfo and /tf_static, which other tools read, and as the text of a
`rig.toml`, which holds what those cannot, so that a run on the bag has the same bytes as one on the recording.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from lodelight.geometry.se3 import SE3
from lodelight.io.clouds import read_ply
from lodelight.io.covariances import read_covariances
from lodelight.io.euroc_writer import stored_depth
from lodelight.io.recording import Recording
from lodelight.io.rig_toml import format_rig
from lodelight.io.rosbag_topics import RIG_TOPIC
from lodelight.io.rosbag_writer import BODY, WORLD, BagWriter
from lodelight.io.trajectories import read_trajectory
from lodelight.messages import Frame, Imu
from lodelight.rig import CameraSpec, DepthSpec, Rig
from lodelight.trajectory import Trajectory
from lodelight.types import AnyArray, Array

MILLIMETRES = 1000.0
ANY_DEPTH_M = (0.0, 1e6)  # of depth whose range has been seen to
Progress = Callable[[Iterator[Frame], int], Iterator[Frame]]
Item = tuple[int, str, Any]  # stamp, kind, message


def write_recording_bag(
    recording: Recording,
    path: Path,
    start_s: float,
    end_s: float,
    progress: Progress = lambda frames, n: frames,
) -> None:
    """Images, depth registered to camera 0, IMU, light camera, rig and truth of a recording; streamed.

    Stamps go onto the body's clock. Depth in millimetres stays 16UC1; any other is written as metres, 32FC1, which is
    exact where millimetres are not.
    """
    rig = bag_rig(recording.rig)
    frames = recording.frames(len(rig.cameras), rig.depth is not None, start_s, end_s)
    exact_mm = recording.rig.depth is not None and _in_millimetres(recording.rig.depth)
    with ExitStack() as stack:
        bag = stack.enter_context(BagWriter(path))
        stack.enter_context(closing(frames))
        streams: list[Iterator[Item]] = [_keyed("frame", progress(frames, recording.n_frames))]
        if rig.imu is not None:
            streams.append(_keyed("imu", recording.inertial(start_s, end_s)))
        if rig.lights is not None:
            lights = stack.enter_context(closing(recording.light_frames(start_s, end_s)))
            streams.append(_keyed("light", lights))
        truth = recording.ground_truth()
        if truth is not None:
            streams.append(_keyed_poses(truth))
        for i, (t_ns, kind, message) in enumerate(heapq.merge(*streams, key=lambda item: item[0])):
            if i == 0:
                _write_rig(bag, rig, t_ns)
            _write_message(bag, rig, kind, message, t_ns, exact_mm)


def bag_rig(rig: Rig) -> Rig:
    """The rig of what the bag will hold: no time offsets, depth as camera 0 sees it."""
    cameras = tuple(replace(spec, time_offset_s=0.0) for spec in rig.cameras)
    depth = rig.depth
    if depth is not None and not _in_millimetres(depth):
        low, high = ANY_DEPTH_M
        depth = replace(depth, units_per_m=MILLIMETRES, min_m=low, max_m=high)
    if depth is not None:
        depth = replace(depth, camera=cameras[0].camera, T_body_depth=cameras[0].T_body_cam, registered=True)
    imu = replace(rig.imu, time_offset_s=0.0) if rig.imu else None
    return Rig(cameras, depth=depth, imu=imu, lights=replace(rig.lights, time_offset_s=0.0) if rig.lights else None)


def _in_millimetres(spec: DepthSpec) -> bool:
    """Whether 16 bit hold its frames exactly: registered readings in the unit ROS gives such images."""
    return spec.registered and spec.units_per_m == MILLIMETRES


def _keyed(kind: str, messages: Iterable[Frame | Imu]) -> Iterator[Item]:
    for message in messages:
        yield message.t_ns, kind, message


def _keyed_poses(truth: Trajectory) -> Iterator[Item]:
    for i, t_ns in enumerate(truth.t_ns.tolist()):
        yield t_ns, "truth", truth.pose(i)


def _write_rig(bag: BagWriter, rig: Rig, t_ns: int) -> None:
    sensors = [(spec.name, spec.T_body_cam) for spec in _all_cameras(rig)]
    if rig.imu is not None:
        sensors.append(("imu0", SE3.identity()))
    edges = [(BODY, name, T) for name, T in sensors]
    bag.write("/tf_static", t_ns, bag.transforms(t_ns, edges), latched=True)
    bag.write(RIG_TOPIC, t_ns, bag.text(format_rig(rig)), latched=True)


def _write_message(bag: BagWriter, rig: Rig, kind: str, message: Any, t_ns: int, exact_mm: bool) -> None:
    if kind == "imu":
        bag.write("/imu0", t_ns, bag.imu(t_ns, "imu0", message.gyro, message.accel))
    elif kind == "truth":
        bag.write("/ground_truth/odom", t_ns, bag.odometry(t_ns, message))
    else:
        specs = (rig.lights,) if kind == "light" and rig.lights else rig.cameras
        for spec, image in zip(specs, message.images, strict=True):
            bag.write(f"/{spec.name}/camera_info", t_ns, bag.camera_info(t_ns, spec.name, spec.camera))
            bag.write(f"/{spec.name}/image_raw", t_ns, bag.image(t_ns, spec.name, image))
        if kind == "frame" and rig.depth is not None and message.depth is not None:
            lens, frame_id = rig.depth.camera, rig.cameras[0].name
            depth = stored_depth(message.depth, rig.depth) if exact_mm else message.depth
            bag.write("/depth0/camera_info", t_ns, bag.camera_info(t_ns, frame_id, lens))
            bag.write("/depth0/image_raw", t_ns, bag.image(t_ns, frame_id, depth))


def _all_cameras(rig: Rig) -> tuple[CameraSpec, ...]:
    return rig.cameras + ((rig.lights,) if rig.lights else ())


def write_trajectory_bag(path: Path, trajectory: Trajectory, covariances: dict[int, Array] | None = None) -> None:
    """A trajectory as Odometry on /odom, Path on /path and transforms on /tf.

    covariances : by stamp, each (6, 6) in the chart of SE3.perturbed
    """
    with BagWriter(path) as bag:
        _write_trajectory(bag, trajectory, covariances or {})


def write_cloud_bag(path: Path, xyz: AnyArray, t_ns: int = 0) -> None:
    """Points (N, 3) m as PointCloud2 on /cloud."""
    with BagWriter(path) as bag:
        bag.write("/cloud", t_ns, bag.cloud(t_ns, xyz), latched=True)


def write_out_folder_bag(folder: Path, path: Path) -> None:
    """What a run left: its final trajectory, with the covariances the poses had at the time, and its cloud."""
    trajectory = read_trajectory(folder / "trajectory.tum")
    covariances: dict[int, Array] = {}
    if (folder / "covariance.csv").is_file():
        t_ns, matrices = read_covariances(folder / "covariance.csv")
        covariances = dict(zip(t_ns.tolist(), matrices, strict=True))
    with BagWriter(path) as bag:
        _write_trajectory(bag, trajectory, covariances)
        if (folder / "cloud.ply").is_file():
            end_ns = int(trajectory.t_ns[-1]) if len(trajectory) else 0
            bag.write("/cloud", end_ns, bag.cloud(end_ns, read_ply(folder / "cloud.ply")), latched=True)


def _write_trajectory(bag: BagWriter, trajectory: Trajectory, covariances: dict[int, Array]) -> None:
    stamps = trajectory.t_ns.tolist()
    poses = [trajectory.pose(i) for i in range(len(trajectory))]
    for t_ns, T in zip(stamps, poses, strict=True):
        bag.write("/odom", t_ns, bag.odometry(t_ns, T, covariances.get(t_ns)))
        bag.write("/tf", t_ns, bag.transforms(t_ns, [(WORLD, BODY, T)]))
    if stamps:
        bag.write("/path", stamps[-1], bag.path(stamps, poses), latched=True)
