"""nav_msgs/Odometry in ROS 1 bags and in ROS 2's MCAP files.

Its pose is T_header_child. Its covariance is ordered x, y, z, rx, ry, rz, all along the fixed axes of the header's
frame; ours is rotation first, and the rotation along the body's axes (the chart of SE3.perturbed):

    Exp(dphi) R = R Exp(dtheta)  =>  dphi = R dtheta,   ros = A ours A^T,  A = [[0, I], [R, 0]]
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import LightFix
from lodelight.types import Array

ODOMETRY = "nav_msgs/msg/Odometry"
TOPIC = "/lights/odometry"
SUFFIXES = (".bag", ".mcap", ".db3")


@dataclass(frozen=True, eq=False)
class OdometryRow:
    """One message as it stands in a bag. xyz (3,) m; quat_xyzw (4,) not normalized; covariance (6, 6), ROS's order."""

    t_ns: int
    frame_id: str
    child_frame_id: str
    xyz: Array
    quat_xyzw: Array
    covariance: Array


def covariance_to_ros(R: Array, ours: Array) -> Array:
    """(6, 6) x, y, z, rx, ry, rz along fixed axes, of one in the chart of SE3.perturbed at rotation R."""
    A = np.zeros((6, 6))
    A[:3, 3:], A[3:, :3] = np.eye(3), R
    out: Array = A @ ours @ A.T
    return out


def covariance_from_ros(R: Array, ros: Array) -> Array:
    """The inverse of `covariance_to_ros`."""
    A = np.zeros((6, 6))
    A[:3, 3:], A[3:, :3] = R.T, np.eye(3)
    out: Array = A @ ros @ A.T
    return out


def write_odometry(
    path: Path, fixes: Sequence[LightFix], frame_id: str = "world", child_frame_id: str = "body"
) -> None:
    """Fixes with a pose, on TOPIC, as a ROS 1 bag (`.bag`) or as MCAP (`.mcap`), by the name; replaces a file.

    Raises SourceError on another name, and where the file cannot be written.
    """
    placed = [(fix, fix.T_world_body) for fix in fixes if fix.T_world_body is not None]
    with _written(path) as (writer, store):
        connection = writer.add_connection(TOPIC, ODOMETRY, typestore=store)
        ros1 = path.suffix == ".bag"
        for seq, (fix, pose) in enumerate(placed):
            message = _message(store, fix, pose, frame_id, child_frame_id, seq if ros1 else None)
            data = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, ODOMETRY)
            writer.write(connection, fix.t_ns, data)


@contextmanager
def _written(path: Path) -> Iterator[tuple[Any, Any]]:
    """A writer and its types; what was written comes to `path` when it is whole."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    if path.suffix not in (".bag", ".mcap"):
        raise SourceError(f"{path}: odometry is written to .bag (ROS 1) or .mcap (ROS 2); end the name in one of these")
    try:
        with tempfile.TemporaryDirectory(prefix=".odometry-", dir=path.parent) as folder:
            there = Path(folder) / "odometry"
            if path.suffix == ".bag":
                there = there.with_suffix(".bag")
                with Writer1(there) as writer1:
                    yield writer1, get_typestore(Stores.ROS1_NOETIC)
            else:
                with Writer2(there, version=9, storage_plugin=StoragePlugin.MCAP) as writer2:
                    yield writer2, get_typestore(Stores.ROS2_HUMBLE)
                there = next(there.glob("*.mcap"))
            shutil.move(there, path)
    except OSError as error:
        raise SourceError(f"cannot write {path}: {error.strerror}; choose another place") from None


def _message(store: Any, fix: LightFix, pose: SE3, frame_id: str, child_frame_id: str, seq: int | None) -> Any:
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=fix.t_ns // NS_PER_S, nanosec=fix.t_ns % NS_PER_S)
    numbered = {} if seq is None else {"seq": seq}
    x, y, z, w = pose.quat_xyzw.tolist()
    point, quaternion = t["geometry_msgs/msg/Point"], t["geometry_msgs/msg/Quaternion"]
    vector = t["geometry_msgs/msg/Vector3"]
    still = t["geometry_msgs/msg/Twist"](linear=vector(x=0.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
    return t[ODOMETRY](
        header=t["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **numbered),
        child_frame_id=child_frame_id,
        pose=t["geometry_msgs/msg/PoseWithCovariance"](
            pose=t["geometry_msgs/msg/Pose"](
                position=point(x=float(pose.t[0]), y=float(pose.t[1]), z=float(pose.t[2])),
                orientation=quaternion(x=x, y=y, z=z, w=w),
            ),
            covariance=covariance_to_ros(pose.R, fix.covariance).ravel(),
        ),
        # lights say nothing of velocity: ROS marks that by -1 in the first place
        twist=t["geometry_msgs/msg/TwistWithCovariance"](twist=still, covariance=np.array([-1.0] + [0.0] * 35)),
    )


def read_odometry_bag(path: Path, topic: str = "") -> list[OdometryRow]:
    """All messages of a topic, in the bag's order; of the only odometry topic there is, if none is named.

    Raises SourceError where the bag cannot be read or has no such topic.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            found = [c for c in reader.connections if c.msgtype == ODOMETRY]
            topics = sorted({c.topic for c in found})
            chosen = topic or (topics[0] if len(topics) == 1 else "")
            if chosen not in topics:
                there = f"its odometry topics are {', '.join(topics)}" if topics else "it has no nav_msgs/Odometry"
                what = f"has no odometry topic {topic!r}" if topic else f"must be named with its topic, {path}:TOPIC"
                raise SourceError(f"{path} {what}; {there}")
            wanted = [c for c in found if c.topic == chosen]
            return [
                _row(reader.deserialize(data, connection.msgtype))
                for connection, _, data in reader.messages(connections=wanted)
            ]
    except SourceError:
        raise
    except Exception as error:  # the library's own family is wide, and a damaged bag fails anywhere in it
        raise SourceError(f"{path} cannot be read as a bag: {error}") from None


def _row(message: Any) -> OdometryRow:
    stamp, pose = message.header.stamp, message.pose.pose
    p, q = pose.position, pose.orientation
    return OdometryRow(
        int(stamp.sec) * NS_PER_S + int(stamp.nanosec),
        message.header.frame_id.lstrip("/"),
        message.child_frame_id.lstrip("/"),
        np.array([p.x, p.y, p.z], dtype=np.float64),
        np.array([q.x, q.y, q.z, q.w], dtype=np.float64),
        np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6),
    )
