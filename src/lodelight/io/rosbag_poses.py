"""Poses in a bag: Odometry, PoseStamped, TransformStamped, Path."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.errors import SourceError
from lodelight.io.rosbag import Bag, stamp_ns
from lodelight.io.rosbag_topics import POSES, TRUTH
from lodelight.trajectory import Trajectory


def read_poses(path: Path, topic: str | None = None) -> Trajectory:
    """The poses of a topic, sorted by stamp; of poses with one stamp the first counts; of Paths the last one.

    topic : None takes the only one there is, or the one that is called ground truth, or the only Odometry
    Raises SourceError where that does not settle it, or the topic holds no pose.
    """
    with Bag(path) as bag:
        topic = topic or _only(bag)
        messages = [message for _, _, message in bag.messages((topic,))]
    if messages and hasattr(messages[0], "poses"):
        messages = messages[-1].poses
    rows = [(stamp_ns(message), *_numbers(message)) for message in messages]
    if not rows:
        raise SourceError(f"{path} {topic} holds no pose")
    values = np.array([row[1:] for row in rows])
    norm = np.linalg.norm(values[:, 3:], axis=1)
    if not np.isfinite(values).all() or (norm < 0.1).any():
        raise SourceError(f"{path} {topic}: a pose has no finite position or no rotation")
    t_ns, first = np.unique(np.array([row[0] for row in rows], dtype=np.int64), return_index=True)
    return Trajectory(t_ns, values[first, :3].copy(), (values[:, 3:] / norm[:, None])[first])


def _only(bag: Bag) -> str:
    found = sorted(topic for topic in bag.types if bag.types[topic] in POSES and bag.counts[topic] > 0)
    for narrower in (
        found,
        [topic for topic in found if TRUTH.search(topic)],
        [topic for topic in found if bag.types[topic] == "nav_msgs/Odometry"],
    ):
        if len(narrower) == 1:
            return narrower[0]
    what = f"poses in {', '.join(found)}; name one with --topic truth=/TOPIC" if found else "no topic of poses"
    raise SourceError(f"{bag.path} has {what}")


def _numbers(message: Any) -> Iterator[float]:
    """x y z qx qy qz qw of any message that holds one pose."""
    part = getattr(message, "pose", None)
    if part is None:
        part = message.transform
    part = getattr(part, "pose", part)  # of one with a covariance
    at = part.position if hasattr(part, "position") else part.translation
    turn = part.orientation if hasattr(part, "orientation") else part.rotation
    yield from (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
