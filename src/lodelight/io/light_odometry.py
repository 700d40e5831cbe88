"""Positions by lights that were made elsewhere: TUM text, or nav_msgs/Odometry in a bag, as fixes of the body."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lodelight.errors import CalibrationError, SourceError
from lodelight.geometry.se3 import SE3, carried_covariance
from lodelight.io.covariances import covariance_from_ros, read_covariances
from lodelight.io.odometry_bag import read_odometry_bag
from lodelight.io.rosbag_writer import SUFFIXES
from lodelight.io.stamps import NS_PER_S, ns_from_seconds, ns_from_text, seconds_text
from lodelight.io.text import fields, lines
from lodelight.messages import LightFix
from lodelight.rig import Rig
from lodelight.types import Array

SIGMA_M, SIGMA_DEG = 0.03, 1.0  # where nothing is said of the noise: that of published robots (science note A6)
NORM_TOLERANCE = 0.02
WORLD = ("world", "map", "")
BODY = ("body", "base_link", "base_footprint", "imu", "imu0", "")
NO_COVARIANCE = np.full((6, 6), np.inf)


def read_light_odometry(text: str, rig: Rig, frame: str = "") -> list[LightFix]:
    """Fixes of the body by rising stamp, from `FILE` or `BAG:TOPIC`.

    frame : whose poses they are: "body", or the light camera's name; default: what a bag says, else the body
    A pose that is none (not finite, a quaternion far from unit length) becomes an abstention with its reason.
    Raises SourceError on a file that cannot be read, has no pose at all, or is in another frame than the world's, and
    CalibrationError where the rig does not say how the light camera sits on the body.
    """
    path, topic = Path(text), ""
    if not path.exists() and ":" in text:
        name, _, topic = text.rpartition(":")
        path = Path(name)
    if not path.exists():
        raise SourceError(f"light odometry {path} does not exist")
    bag = path.is_dir() or path.suffix in SUFFIXES
    fixes = sorted(_of_bag(path, topic, rig, frame) if bag else _of_text(path, rig, frame), key=lambda fix: fix.t_ns)
    if not any(fix.T_world_body is not None for fix in fixes):
        why = f": {fixes[0].why}" if fixes else ""
        raise SourceError(f"light odometry {path} has no pose that can be used{why}")
    return fixes


def check_clock(fixes: list[LightFix], span_ns: tuple[int, int], where: str) -> None:
    """Raises SourceError where no fix falls into a recording: then one of the two has another clock."""
    first, last = fixes[0].t_ns, fixes[-1].t_ns
    if last >= span_ns[0] and first <= span_ns[1]:
        return
    off_s = (first - span_ns[0]) / NS_PER_S
    raise SourceError(
        f"light odometry {where} is of another time: it begins {abs(off_s):.3f} s {'after' if off_s > 0 else 'before'} "
        "the recording does, and they never overlap; put both on one clock"
    )


def _of_bag(path: Path, topic: str, rig: Rig, frame: str) -> Iterator[LightFix]:
    for row in read_odometry_bag(path, topic):
        if row.frame_id not in WORLD:
            raise SourceError(
                f"{path}: its poses are in the frame {row.frame_id!r}; lights are surveyed in 'world' (or 'map')"
            )
        pose, why = _pose(row.xyz, row.quat_xyzw)
        covariance = row.covariance
        if pose is not None and (not np.isfinite(covariance).all() or (np.diag(covariance) <= 0.0).any()):
            ours = _default()  # ROS: zeros, or -1 in the first place, say "not known"
        else:
            ours = covariance_from_ros(pose.R, covariance) if pose is not None else NO_COVARIANCE
        yield _fix(row.t_ns, pose, why, ours, frame or row.child_frame_id, rig, path)


def _of_text(path: Path, rig: Rig, frame: str) -> Iterator[LightFix]:
    beside = path.with_name("covariance.csv")
    known: dict[int, Array] = {}
    if beside.is_file():
        t_ns, covariances = read_covariances(beside)
        known = dict(zip(t_ns.tolist(), covariances, strict=True))
    for number, line in lines(path):
        cells = fields(line)
        euroc = "," in line
        try:
            t = (ns_from_text if euroc else ns_from_seconds)(cells[0])
            values = np.array([float(cell) for cell in cells[1:8]])
        except ValueError:
            raise SourceError(f"{path} line {number}: expected a stamp and seven numbers, got {line[:60]!r}") from None
        if len(values) < 7:
            raise SourceError(f"{path} line {number}: expected a stamp and seven numbers, got {line[:60]!r}")
        pose, why = _pose(values[:3], values[[4, 5, 6, 3]] if euroc else values[3:7])
        yield _fix(t, pose, why, known.get(t, _default()), frame, rig, path)


def _default() -> Array:
    """In our order; the same along any axes."""
    return np.diag([math.radians(SIGMA_DEG) ** 2] * 3 + [SIGMA_M**2] * 3)


def _pose(xyz: Array, quat_xyzw: Array) -> tuple[SE3 | None, str]:
    if not (np.isfinite(xyz).all() and np.isfinite(quat_xyzw).all()):
        return None, "its pose is not finite"
    norm = float(np.linalg.norm(quat_xyzw))
    if abs(norm - 1.0) > NORM_TOLERANCE:
        return None, f"its quaternion has length {norm:.3g}, a rotation's is 1"
    return SE3.from_quat_xyzw(xyz, quat_xyzw), ""


def _fix(t_ns: int, pose: SE3 | None, why: str, covariance: Array, frame: str, rig: Rig, path: Path) -> LightFix:
    """The fix of the body, from a pose of the body or of the light camera."""
    if pose is None:
        return LightFix(t_ns, None, NO_COVARIANCE, why=f"at {seconds_text(t_ns)} s {why}")
    if frame in BODY:
        return LightFix(t_ns, pose, covariance)
    if rig.lights is None:
        raise CalibrationError(
            f"{path} holds poses of {frame!r}, and the rig does not say where that sits on the body: add a [lights] "
            "table with T_body_cam to rig.toml, or say --light-frame body"
        )
    if frame != rig.lights.name:
        raise CalibrationError(
            f"{path} holds poses of {frame!r}; the rig knows the body and {rig.lights.name!r}; name one: --light-frame"
        )
    T_world_body = pose @ rig.lights.T_body_cam.inverse()
    return LightFix(t_ns, T_world_body, carried_covariance(pose, covariance, T_world_body))
