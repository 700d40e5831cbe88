"""ROS messages from and to arrays. ROS 1 and ROS 2 differ in where the classes come from, and in how they write time.

types : a namespace with the message classes; stamp : t_ns -> the time of that ROS
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np

from lodelight.errors import CalibrationError
from lodelight.geometry.se3 import SE3
from lodelight.io.covariances import covariance_from_ros, covariance_to_ros
from lodelight.io.rosbag_images import grey, raw_depth
from lodelight.io.rosbag_rig import lens_of_info, pair_by_projection
from lodelight.messages import LightFix
from lodelight.rig import CameraSpec, DepthSpec, Rig
from lodelight.types import AnyArray, Array, ArrayF32, Bytes

OPTICAL = SE3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))  # x right to x ahead
LEVELS = {"tracking": 0, "relocalized": 0, "degraded": 1, "initializing": 1, "lost": 2}  # of diagnostic_msgs
FLOAT32 = 7  # of sensor_msgs/PointField


def stamp_ns(message: Any) -> int:
    """Of the header, in either ROS."""
    stamp = message.header.stamp
    seconds = getattr(stamp, "secs", None)
    if seconds is not None:
        return int(seconds) * 10**9 + int(stamp.nsecs)
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def grey_image(message: Any, size: tuple[int, int]) -> Bytes:
    """(H, W) uint8 of an Image or CompressedImage. Raises BadFrame."""
    return grey(_with_array(message), size)


def depth_image(message: Any, spec: DepthSpec) -> ArrayF32:
    """(H, W) float32 m of a registered depth Image. Raises BadFrame."""
    raw = raw_depth(_with_array(message), (spec.camera.width, spec.camera.height))
    metres = raw.astype(np.float32) / np.float32(1.0 if raw.dtype == np.float32 else spec.units_per_m)
    out: ArrayF32 = np.where((metres >= spec.min_m) & (metres <= spec.max_m), metres, 0.0).astype(np.float32)
    return out


def _with_array(message: Any) -> Any:
    """The same message, its bytes as an array."""
    names = ("format",) if hasattr(message, "format") else ("encoding", "width", "height", "step", "is_bigendian")
    fields = {name: getattr(message, name) for name in names}
    return SimpleNamespace(**fields, data=np.frombuffer(message.data, np.uint8))


def vector(v: Any) -> Array:
    return np.array([v.x, v.y, v.z], dtype=np.float64)


def light_fix(message: Any) -> LightFix:
    """An Odometry of the body in the world, as light positioning publishes it."""
    q = message.pose.pose.orientation
    T = SE3.from_quat_xyzw(vector(message.pose.pose.position), np.array([q.x, q.y, q.z, q.w]))
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return LightFix(stamp_ns(message), T, covariance_from_ros(T.R, covariance))


def rig_of_infos(infos: list[Any], topics: list[str], depth: bool) -> Rig:
    """Of CameraInfo messages: base_link sits in camera 0, x ahead, z up; a second one stands by its projection matrix.

    Raises CalibrationError where a camera is not calibrated, or a pair has no baseline.
    """
    cameras = [CameraSpec("cam0", lens_of_info(infos[0], topics[0]), OPTICAL)]
    if len(infos) > 1:
        T_cam0_cam1 = pair_by_projection(infos[0], infos[1])
        if T_cam0_cam1 is None:
            raise CalibrationError("the CameraInfo of the pair holds no baseline; give a rig file")
        cameras.append(CameraSpec("cam1", lens_of_info(infos[1], topics[1]), OPTICAL @ T_cam0_cam1))
    return Rig(tuple(cameras), depth=DepthSpec(cameras[0].camera, OPTICAL) if depth else None)


# -- out ------------------------------------------------------------------------------------------------------------


def _header(message: Any, stamp: Any, frame: str) -> None:
    message.header.stamp, message.header.frame_id = stamp, frame


def _fill_pose(pose: Any, T: SE3) -> None:
    pose.position.x, pose.position.y, pose.position.z = T.t.tolist()
    q = pose.orientation
    q.x, q.y, q.z, q.w = T.quat_xyzw.tolist()


def odometry(types: Any, stamp: Any, parent: str, child: str, T: SE3, covariance: Array, velocity: Array) -> Any:
    """covariance : (6, 6), chart of SE3.perturbed, position in the axes of `parent`; velocity (6,) in child's axes."""
    message = types.Odometry()
    _header(message, stamp, parent)
    message.child_frame_id = child
    _fill_pose(message.pose.pose, T)
    message.pose.covariance = covariance_to_ros(T.R, covariance).ravel().tolist()
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = velocity.tolist()
    return message


def path(types: Any, stamp: Callable[[int], Any], frame: str, poses: Iterable[tuple[int, SE3]]) -> Any:
    message, last = types.Path(), 0
    for t_ns, T in poses:
        stamped = types.PoseStamped()
        _header(stamped, stamp(t_ns), frame)
        _fill_pose(stamped.pose, T)
        message.poses.append(stamped)
        last = t_ns
    _header(message, stamp(last), frame)
    return message


def transform(types: Any, stamp: Any, parent: str, child: str, T: SE3) -> Any:
    message = types.TransformStamped()
    _header(message, stamp, parent)
    message.child_frame_id = child
    at, q = message.transform.translation, message.transform.rotation
    at.x, at.y, at.z = T.t.tolist()
    q.x, q.y, q.z, q.w = T.quat_xyzw.tolist()
    return message


def cloud(types: Any, stamp: Any, frame: str, xyz: AnyArray) -> Any:
    message = types.PointCloud2()
    _header(message, stamp, frame)
    for i, name in enumerate("xyz"):
        named = types.PointField()
        named.name, named.offset, named.datatype, named.count = name, 4 * i, FLOAT32, 1
        message.fields.append(named)
    message.height, message.width = 1, len(xyz)
    message.point_step, message.row_step = 12, 12 * len(xyz)
    message.is_bigendian, message.is_dense = False, True
    message.data = np.ascontiguousarray(xyz, dtype="<f4").tobytes()
    return message


def diagnostics(types: Any, stamp: Any, values: dict[str, str]) -> Any:
    status = types.DiagnosticStatus()
    level = LEVELS[values["state"]]
    status.level = level if isinstance(status.level, int) else bytes([level])  # ROS 2 has a byte there
    status.name, status.hardware_id = "lodelight: localization", "lodelight"
    status.message = values["why"] or values["state"]
    for key, value in values.items():
        pair = types.KeyValue()
        pair.key, pair.value = key, value
        status.values.append(pair)
    message = types.DiagnosticArray()
    message.header.stamp = stamp
    message.status.append(status)
    return message
