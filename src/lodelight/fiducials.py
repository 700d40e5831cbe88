"""Square codes by family and number: what is printed, in black and white modules.

Families are named as in `anchors.toml`: AprilTag's own names (tag36h11), or aruco_ and the dictionary of OpenCV
(aruco_4x4_50).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from lodelight.errors import ConfigError
from lodelight.types import Bytes

APRILTAG = {"tag16h5": "DICT_APRILTAG_16h5", "tag25h9": "DICT_APRILTAG_25h9", "tag36h11": "DICT_APRILTAG_36h11"}
ARUCO = {
    f"aruco_{bits}x{bits}_{count}": f"DICT_{bits}X{bits}_{count}"
    for bits in (4, 5, 6, 7)
    for count in (50, 100, 250, 1000)
} | {"aruco_original": "DICT_ARUCO_ORIGINAL", "aruco_mip_36h12": "DICT_ARUCO_MIP_36h12"}
FAMILIES = (*APRILTAG, *ARUCO)


def dictionary(family: str) -> Any:
    """OpenCV's dictionary of a family. Raises ConfigError on an unknown one."""
    import cv2

    name = APRILTAG.get(family) or ARUCO.get(family)
    if name is None or not hasattr(cv2.aruco, name):
        raise ConfigError(f"tag family {family!r} is unknown; choose qr or one of {', '.join(FAMILIES)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@lru_cache(maxsize=4096)
def fiducial_modules(family: str, number: int) -> Bytes:
    """(n, n) uint8 as one reads it, black border included: 0 black, 1 white. Raises ConfigError on what there is not.

    OpenCV keeps AprilTags upside down; here they stand as the AprilTag library prints them and names their corners.
    """
    import cv2

    book = dictionary(family)
    count = len(book.bytesList)
    if not 0 <= number < count:
        raise ConfigError(f"{family} has the numbers 0 to {count - 1}, not {number}")
    side = int(book.markerSize) + 2
    image = np.asarray(cv2.aruco.generateImageMarker(book, number, side)) > 127
    modules = np.ascontiguousarray(np.rot90(image, 2) if family in APRILTAG else image).astype(np.uint8)
    modules.flags.writeable = False
    return modules


def qr_modules(text: str) -> Bytes:
    """(n, n) uint8 of a QR code without its quiet zone: 0 black, 1 white; a quarter of it may be lost or covered.

    Raises ConfigError on a text that no code can hold.
    """
    import cv2

    params = cv2.QRCodeEncoder_Params()  # type: ignore[attr-defined, unused-ignore]
    params.correction_level = cv2.QRCodeEncoder_CORRECT_LEVEL_M
    try:
        image = cv2.QRCodeEncoder_create(params).encode(text) > 127  # type: ignore[attr-defined, unused-ignore]
    except cv2.error:
        raise ConfigError(f"a QR code cannot hold these {len(text)} characters; use fewer") from None
    dark = np.flatnonzero(~image.all(axis=1))  # the encoder frames the code as it likes
    return np.asarray(image[dark[0] : dark[-1] + 1, dark[0] : dark[-1] + 1], np.uint8)
