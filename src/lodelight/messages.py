"""What flows: sensors' messages in, estimates out. Everything a stage hands to the next is one of these."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.types import Array, ArrayF32, Bytes

LOST_COVARIANCE = np.diag(
    [np.pi**2] * 3 + [1e6] * 3
)  # of a pose of which nothing is known: half a turn and a kilometre

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


@dataclass(frozen=True, eq=False)
class LightSighting:
    """A spot in an image of the light camera.

    t_ns : when the row of its centre was exposed; centre_px (2,) (u, v), covariance_px (2, 2)
    candidates : ids of the lights that have its code, none where it is unknown, and then `why` says the reason
    frequency_hz 0 : no stripes; clear : enough of them, and nothing else
    edges (N, 2) px : of its outline; box_px : left, top, width, height
    """

    t_ns: int
    centre_px: Array
    covariance_px: Array
    diameter_rows: float
    frequency_hz: float = 0.0
    sigma_hz: float = float("inf")
    candidates: tuple[str, ...] = ()
    confidence: float = 0.0
    why: str = ""
    clear: bool = False
    edges: Array = field(default_factory=lambda: np.zeros((0, 2)))
    box_px: tuple[int, int, int, int] = (0, 0, 0, 0)

    @property
    def id(self) -> str | None:
        """Its light, where only one has its code."""
        return self.candidates[0] if len(self.candidates) == 1 else None

    @property
    def sigma_px(self) -> float:
        """Of the centre, the mean of both axes."""
        return float(np.sqrt(0.5 * np.trace(self.covariance_px)))


@dataclass(frozen=True, eq=False)
class LightFix:
    """Where the body was by the lights alone; covariance as in `Estimate`.

    lights : ids, of the sightings used; rms_px : of the distances between seen and expected centres
    T_world_body None : abstained, `why` says it
    seen : every named sighting of the image, also those that no position came of
    up_body (3,) : unit, the way up that it was levelled by, and the sigma of that about either horizontal axis; None
        where that is not known
    """

    t_ns: int
    T_world_body: SE3 | None
    covariance: Array
    lights: tuple[str, ...] = ()
    rms_px: float = 0.0
    why: str = ""
    seen: tuple[LightSighting, ...] = ()
    up_body: Array | None = None
    sigma_up_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class TagSighting:
    """A printed code in an image of camera `camera` (its row in the rig), read and checked against its print.

    id : as in `anchors.toml`: the number as text; of a QR code its id field, or the whole payload
    corners_px (4, 2) px, in the order of `anchors.tag_corners`; sigma_px (4,) noise of each corner, per axis
    size_m, T_world_tag : what a QR code says of itself, None where it does not; nobody has checked it
    agreement : correlation of the image with the code as it is printed, 1 at best
    """

    t_ns: int
    family: str
    id: str
    corners_px: Array
    sigma_px: Array
    camera: int = 0
    size_m: float | None = None
    T_world_tag: SE3 | None = None
    agreement: float = 1.0

    @property
    def name(self) -> str:
        """Family and id in one, unique in a building."""
        return f"{self.family} {self.id}"

    @property
    def side_px(self) -> float:
        """The shortest side."""
        return float(np.linalg.norm(np.roll(self.corners_px, -1, axis=0) - self.corners_px, axis=1).min())


@dataclass(frozen=True, eq=False)
class Doubt:
    """Where an anchor of the building says a frame was taken. sure : it is believed even if nothing is found there."""

    T_world_body: SE3
    covariance: Array
    sure: bool


Message: TypeAlias = Imu | Frame | LightFix


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
