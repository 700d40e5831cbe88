"""What is known of the building: tags on its walls and coded lights under its ceiling.

Tag frame, all families: origin in the middle of the code, x to the right and y down as one reads it, z into the
wall. A camera that looks at a tag squarely has the tag's axes: R_cam_tag = I. The frame of the AprilTag library.
Files: `anchors.toml`, read and written in `lodelight.io.anchors_toml`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.types import Array


def tag_corners(size_m: float) -> Array:
    """Corners of the code in the tag frame, (4, 3) m, counter-clockwise from the lower left as one reads it."""
    h = 0.5 * size_m
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


@dataclass(frozen=True, eq=False)
class Tag:
    """A printed code. `T_world_tag` is None where its place is not known; sigma_m is the survey's, per axis.

    family : "qr", "tag36h11", "aruco_4x4_50", ...; id : the number as text, or the QR code's id field or payload
    size_m : side of the code without its quiet zone (for AprilTag and ArUco: of the black border)
    """

    family: str
    id: str
    size_m: float
    T_world_tag: SE3 | None = None
    sigma_m: float = 0.005

    @property
    def corners_world(self) -> Array | None:
        """(4, 3) m, in the order of `tag_corners`; None where the tag's place is not known."""
        return None if self.T_world_tag is None else self.T_world_tag @ tag_corners(self.size_m)


@dataclass(frozen=True, eq=False)
class Light:
    """A coded ceiling light: a disc of `radius_m` that shines along `normal`.

    It blinks at a frequency of its own; or, where it has a `word` of bits ("01101001"), says that in Manchester code
    with `frequency_hz` half bits a second.
    """

    id: str
    frequency_hz: float
    xyz: Array
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    radius_m: float = 0.09
    sigma_m: float = 0.005
    word: str = ""


@dataclass(frozen=True, eq=False)
class Anchors:
    """Everything surveyed in a building."""

    tags: tuple[Tag, ...] = ()
    lights: tuple[Light, ...] = ()
