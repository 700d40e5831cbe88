"""What flows: sensors' messages in, estimates out. Everything a stage hands to the next is one of these."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from lodelight.geometry.se3 import SE3
from lodelight.types import Array, ArrayF32, Bytes

Status: TypeAlias = Literal["initializing", "tracking", "degraded", "lost", "relocalized"]


@dataclass(frozen=True, eq=False)
class Imu:
    """One inertial sample in the body frame: gyro rad/s, accel m/s^2 (specific force; +9.81 up at rest)."""

    t_ns: int
    gyro: Array
    accel: Array


@dataclass(frozen=True, eq=False)
class Frame:
    """The images of one instant.

    images : grey (H, W) uint8, one per camera of the rig that was asked for, in the rig's order
    depth : (H, W) float32 m along z of camera 0, registered to it, 0 = no reading; None without a depth sensor
    """

    t_ns: int
    images: tuple[Bytes, ...]
    depth: ArrayF32 | None = None


Message: TypeAlias = Imu | Frame


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is believed of one frame at the time it came.

    covariance : (6, 6), rotation (rad, body frame) first, then position (m, world axes): the chart of SE3.perturbed
    why : the reason of a status that is not plain tracking, in words
    """

    t_ns: int
    status: Status
    T_world_body: SE3
    covariance: Array
    why: str = ""
    inliers: int = 0
    details: dict[str, float] = field(default_factory=dict)

    @property
    def localized(self) -> bool:
        return self.status in ("tracking", "degraded", "relocalized")
