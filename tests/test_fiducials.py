"""Printed codes against the AprilTag library, whose frame ours is."""

import numpy as np
import pytest

from lodelight.anchors import tag_corners
from lodelight.errors import ConfigError
from lodelight.fiducials import FAMILIES, dictionary, fiducial_modules


@pytest.mark.parametrize("number", [0, 7, 101])
def test_apriltags_stand_as_the_apriltag_library_sees_them(number):
    from lodelight.tags.apriltags import detect_apriltags

    modules = fiducial_modules("tag36h11", number)
    page = np.full((240, 240), 255, np.uint8)
    page[40:200, 40:200] = np.kron(modules * 255, np.ones((20, 20), np.uint8))
    (found,) = detect_apriltags(page, "tag36h11")
    assert found.number == number
    expected = 119.5 + 160.0 * tag_corners(1.0)[:, :2]  # pixel 40 begins at 39.5
    assert np.abs(found.corners_px - expected).max() < 0.3


@pytest.mark.parametrize("family", [f for f in FAMILIES if f != "aruco_mip_36h12"])
def test_every_family_has_codes_with_a_black_border(family):
    modules = fiducial_modules(family, 1)
    assert modules.shape == (int(dictionary(family).markerSize) + 2,) * 2
    border = np.ones(modules.shape, bool)
    border[1:-1, 1:-1] = False
    assert not modules[border].any()
    assert modules[~border].any()


def test_what_is_not_printed_is_named():
    with pytest.raises(ConfigError, match="0 to 586, not 587"):
        fiducial_modules("tag36h11", 587)
    with pytest.raises(ConfigError, match=r"tag36h10x.*aruco_4x4_50"):
        fiducial_modules("tag36h10x", 0)
