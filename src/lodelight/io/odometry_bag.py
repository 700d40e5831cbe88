"""nav_msgs/Odometry of lights in ROS 1 bags and ROS 2 files. Its pose is T_header_child."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.errors import SourceError
from lodelight.io.rosbag_writer import BagWriter
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import LightFix
from lodelight.types import Array

ODOMETRY = "nav_msgs/msg/Odometry"
TOPIC = "/lights/odometry"


@dataclass(frozen=True, eq=False)
class OdometryRow:
    """One message as it stands in a bag. xyz (3,) m; quat_xyzw (4,) not normalized; covariance (6, 6), ROS's order."""

    t_ns: int
    frame_id: str
    child_frame_id: str
    xyz: Array
    quat_xyzw: Array
    covariance: Array


def write_odometry(path: Path, fixes: Sequence[LightFix], world: str = "world", body: str = "body") -> None:
    """Fixes with a pose, on TOPIC, as a ROS 1 bag (`.bag`) or ROS 2's (`.mcap`, `.db3`), by the name; replaces a file.

    Raises SourceError on another name, and where the file cannot be written.
    """
    with BagWriter(path, replace=True) as bag:
        for fix in fixes:
            if fix.T_world_body is not None:
                bag.write(TOPIC, fix.t_ns, bag.odometry(fix.t_ns, fix.T_world_body, fix.covariance, world, body))


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
