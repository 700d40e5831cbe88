"""Which topic of a bag is which sensor: by the types of its messages, or as named."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lodelight.errors import ConfigError, SourceError
from lodelight.io.rosbag import Bag
from lodelight.io.rosbag_images import COMPRESSED, IMAGE, encoding_of, is_depth, is_image, size_of

IMU, INFO = "sensor_msgs/Imu", "sensor_msgs/CameraInfo"
RIG_TOPIC = "/lodelight/rig"  # std_msgs/String, the text of a rig.toml
POSES = (
    *("nav_msgs/Odometry", "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"),
    *("geometry_msgs/TransformStamped", "nav_msgs/Path"),
)
TRUTH = re.compile("ground_?truth", re.IGNORECASE)
ROLES = {"depth": (IMAGE, COMPRESSED), "lights": (IMAGE, COMPRESSED), "imu": (IMU,), "truth": POSES}
SUFFIX = re.compile("/(compressed|compressedDepth)$")


@dataclass(frozen=True)
class Topics:
    """The topic of each sensor; of a camera with several, the images as they were taken before compressed ones."""

    cameras: tuple[str, ...]
    depth: str | None = None
    imu: str | None = None
    lights: str | None = None
    truth: str | None = None


def parse_roles(texts: list[str]) -> dict[str, str]:
    """`role=/topic` as written on a command line. Raises ConfigError."""
    roles: dict[str, str] = {}
    for text in texts:
        role, _, topic = text.partition("=")
        if not topic or not (role in ROLES or re.fullmatch(r"cam\d", role)):
            raise ConfigError(f"--topic {text}: write role=/topic with a role of cam0, cam1, {', '.join(ROLES)}")
        roles[role] = topic if topic.startswith("/") else f"/{topic}"
    return roles


def find_topics(bag: Bag, roles: Mapping[str, str], n_cameras: int | None) -> Topics:
    """roles : those that were named; n_cameras : of the rig, where it is known beforehand.

    Raises SourceError where a named topic is missing, empty or of another type, and where there is no camera.
    """
    for role, topic in roles.items():
        _check(bag, role, topic)
    named = tuple(roles[role] for role in sorted(roles) if role.startswith("cam"))
    images = {topic: bag.first(topic) for topic in _images(bag)}
    depths = [topic for topic, message in images.items() if is_depth(message, topic)]
    lights = [topic for topic in images if re.search(r"/light[^/]*/", topic)]
    depth = roles.get("depth") or next(iter(depths), None)
    taken = {*depths, *lights, *roles.values()}
    grey = {topic: message for topic, message in images.items() if topic not in taken and is_image(message)}
    cameras = named or _cameras(bag, grey, n_cameras, bag.first(depth) if depth else None)
    if not cameras:
        raise SourceError(f"{bag.path} has no camera: {_inventory(bag)}; name one with --topic cam0=/TOPIC")
    imus = _of_types(bag, (IMU,))
    truths = [topic for topic in _of_types(bag, POSES) if TRUTH.search(topic)]
    return Topics(
        cameras,
        depth=depth,
        imu=roles.get("imu") or next(iter(imus), None),
        lights=roles.get("lights") or next(iter(lights), None),
        truth=roles.get("truth") or next(iter(truths), None),
    )


def info_of(bag: Bag, topic: str, infos: Mapping[str, Any], frame_id: str) -> Any | None:
    """The CameraInfo of an image topic: the one beside it, else the one of its frame."""
    beside = SUFFIX.sub("", topic).rpartition("/")[0] + "/camera_info"
    if beside in infos:
        return infos[beside]
    return next((info for info in infos.values() if info.header.frame_id == frame_id), None)


def camera_infos(bag: Bag) -> dict[str, Any]:
    """The first CameraInfo of each topic that has one."""
    return {topic: bag.first(topic) for topic in _of_types(bag, (INFO,))}


def _cameras(bag: Bag, grey: Mapping[str, Any], n_cameras: int | None, depth: Any | None) -> tuple[str, ...]:
    """Those that have a CameraInfo, if any has; of more than two, those that are alike and belong together.

    First comes the camera that depth is registered to, then the others by name, which puts left before right.
    """
    if n_cameras is not None and len(grey) == n_cameras:
        return tuple(grey)
    infos = camera_infos(bag)
    told = [topic for topic, message in grey.items() if info_of(bag, topic, infos, message.header.frame_id)]
    names = told or list(grey)
    aligned = [t for t in names if depth is not None and grey[t].header.frame_id == depth.header.frame_id]
    if len(names) > 2 or aligned:
        alike = {topic: (size_of(grey[topic]), encoding_of(grey[topic])) for topic in names}
        counts = Counter(alike.values())
        first = aligned[0] if aligned else max(names, key=lambda topic: counts[alike[topic]])
        names = [first, *(topic for topic in names if topic != first and alike[topic] == alike[first])]
    return tuple(names)


def _images(bag: Bag) -> list[str]:
    """One topic for each camera, by name in the order of their numbers."""
    best: dict[str, str] = {}
    for topic in _of_types(bag, (IMAGE, COMPRESSED)):
        camera = SUFFIX.sub("", topic)
        if camera not in best or bag.types[topic] == IMAGE:
            best[camera] = topic
    return sorted(best.values(), key=_natural)


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _of_types(bag: Bag, types: tuple[str, ...]) -> list[str]:
    return sorted((t for t in bag.types if bag.types[t] in types and bag.counts[t] > 0), key=_natural)


def _check(bag: Bag, role: str, topic: str) -> None:
    wanted = ROLES.get(role, (IMAGE, COMPRESSED))
    if topic not in bag.types:
        raise SourceError(f"{bag.path} has no topic {topic} ({role}); {_inventory(bag)}")
    if bag.types[topic] not in wanted:
        raise SourceError(f"{topic} of {bag.path} is {bag.types[topic]}; {role} must be {' or '.join(wanted)}")
    if not bag.counts[topic]:
        raise SourceError(f"{topic} of {bag.path} ({role}) has no message")


def _inventory(bag: Bag) -> str:
    if not bag.types:
        return "it has no topic at all"
    listed = [f"{topic} ({bag.types[topic]})" for topic in sorted(bag.types)]
    more = f" and {len(listed) - 12} more" if len(listed) > 12 else ""
    return f"it has {', '.join(listed[:12])}{more}"
