"""Tags in images against a ray caster of our tests' own, real photos, and codes that lie."""

import cv2
import numpy as np
import pytest

from conftest import shared_data
from lodelight.errors import ConfigError
from lodelight.fiducials import fiducial_modules
from lodelight.geometry.cameras import Camera
from lodelight.geometry.so3 import rotation_angle
from lodelight.tags.detect import TagDetector
from lodelight.tags.pose import tag_poses
from tag_scenes import EUROC, FISHEYE, Print, april, facing, picture, qr

WALL = [
    april(7, facing((-0.9, 0.2, 2.0), (0.1, 0.5, 0.2))),
    april(33, facing((0.8, 0.4, 2.6), (-0.3, -0.4, 0.0)), 0.3),
    qr("LODE1;id=A17;size=0.30", facing((0.1, -0.3, 1.6), (0.2, -0.3, 0.1)), 0.3),
]


def by_name(sightings):
    return {s.name: s for s in sightings}


@pytest.mark.parametrize(("camera", "blur_px"), [(EUROC, 0.3), (EUROC, 1.2), (FISHEYE, 0.3)])
def test_corners_are_found_to_a_fraction_of_a_pixel(camera, blur_px):
    found = by_name(TagDetector(camera).detect(picture(camera, WALL, blur_px), 5))
    assert set(found) == {"tag36h11 7", "tag36h11 33", "qr A17"}
    for name, expected in zip(("tag36h11 7", "tag36h11 33", "qr A17"), WALL, strict=True):
        error_px = found[name].corners_px - expected.corners_px(camera)
        assert np.abs(error_px).max() < 0.35  # the fit's own estimate is 0.1 to 0.2 px
        assert found[name].agreement > 0.85
        assert found[name].t_ns == 5
    assert found["qr A17"].size_m == 0.3
    assert found["tag36h11 7"].size_m is None


def test_errors_of_corners_are_what_sigma_says():
    rng = np.random.default_rng(1)
    normalized = []
    for k in range(12):
        turn = rng.normal(0.0, 0.35, 3)
        xyz = rng.uniform((-0.5, -0.3, 0.8), (0.5, 0.3, 1.8))
        tag = april(k, facing(xyz, turn)) if k % 2 else qr(f"LODE1;id={k};size=0.2", facing(xyz, turn))
        found = TagDetector(EUROC).detect(picture(EUROC, [tag], seed=k), 0)
        normalized += [(s.corners_px - tag.corners_px(EUROC)) / s.sigma_px[:, None] for s in found]
    assert len(normalized) >= 10
    rms = np.sqrt(np.mean(np.square(normalized)))
    assert 0.2 < rms < 1.3  # on the safe side, and not by a factor


def test_aruco_markers_are_found_when_asked_for():
    tag = Print(fiducial_modules("aruco_4x4_50", 11), facing((0.1, 0.1, 1.2), (0.2, 0.3, 0.5)), 0.2)
    image = picture(EUROC, [tag])
    assert TagDetector(EUROC).detect(image, 0) == []
    (found,) = TagDetector(EUROC, ["aruco_4x4_50"]).detect(image, 0)
    assert found.name == "aruco_4x4_50 11"
    assert np.abs(found.corners_px - tag.corners_px(EUROC)).max() < 0.35


def test_a_tag_in_view_is_followed_between_searches():
    detector = TagDetector(EUROC)
    for k in range(7):  # moving by 12 px an image
        tag = april(3, facing((-0.3 + 0.05 * k, 0.0, 2.0)))
        (found,) = detector.detect(picture(EUROC, [tag], seed=k), k)
        assert np.abs(found.corners_px - tag.corners_px(EUROC)).max() < 0.35


def test_codes_that_cannot_be_trusted_are_refused_with_a_reason():
    sharp = facing((0.0, 0.0, 1.5))
    plain = picture(EUROC, [qr("LODE1;id=A17;size=0.2", sharp, 0.3)])
    detector = TagDetector(EUROC)
    assert detector.detect(np.ascontiguousarray(plain[:, ::-1]), 0) == []
    assert "mirrored" in detector.refused[0].why

    image = picture(EUROC, [april(5, facing((0.0, 0.0, 1.2)), 0.4)])
    x = april(5, facing((0.0, 0.0, 1.2)), 0.4).corners_px(EUROC)[:, 0].mean().astype(int)
    cut = image[:, : x + 68]  # its right side touches the edge
    narrow = Camera.create("radtan", cut.shape[1], 480, (458.0, 457.0, 367.0, 248.0))
    assert TagDetector(narrow).detect(np.ascontiguousarray(cut), 0) == []

    small = TagDetector(EUROC)
    assert small.detect(picture(EUROC, [april(5, facing((0.0, 0.0, 7.0)))]), 0) == []
    assert all("px" in r.why for r in small.refused)


def test_a_misread_code_does_not_fit_its_print():
    from lodelight.tags.pattern import fit_pattern

    tag = april(7, facing((0.2, 0.1, 1.4), (0.1, 0.4, 0.0)))
    image, corners = picture(EUROC, [tag]), tag.corners_px(EUROC)
    right = fit_pattern(image, EUROC, fiducial_modules("tag36h11", 7), corners, 0.4)
    assert right.agreement > 0.95
    for wrong in (8, 100, 321):
        fit = fit_pattern(image, EUROC, fiducial_modules("tag36h11", wrong), corners, 0.4)
        assert fit is None or fit.agreement < 0.7


@pytest.mark.parametrize(
    "text",
    [
        "LODE1;id=A17;size=nan",
        "LODE1;id=A17;size=-0.2",
        "LODE1;id=A17;size=0.2;xyz=1,2;quat=0,0,0,1",
        "LODE1;id=A17;size=0.2;xyz=1,2,inf;quat=0,0,0,1",
        "LODE1;id=A17;size=0.2;xyz=1,2,3;quat=0,0,0,2",
        "LODE1;id=A17;size=0.2;xyz=1,2,3;quat=",
        "LODE1;id=" + "A" * 90 + ";size=0.2",
        "LODE1;size=0.2",
    ],
)
def test_hostile_payloads_are_named_and_survived(text):
    detector = TagDetector(EUROC)
    assert detector.detect(picture(EUROC, [qr(text, facing((0.0, 0.0, 0.7)), 0.3)]), 0) == []
    (refused,) = detector.refused
    assert "LODE1" in refused.why
    assert len(refused.why) < 250


def test_other_peoples_codes_go_by_their_text():
    tag = qr("https://example.org/menu", facing((0.0, 0.0, 0.9)), 0.25)
    (found,) = TagDetector(EUROC).detect(picture(EUROC, [tag]), 0)
    assert (found.id, found.size_m, found.T_world_tag) == ("https://example.org/menu", None, None)


def test_unknown_families_are_named():
    with pytest.raises(ConfigError, match="tag99"):
        TagDetector(EUROC, ["tag99"])


def photo(name):
    folder = shared_data("apriltag_photos")
    return cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)


def test_real_photos_give_their_ids():
    lens = Camera.create("radtan", 640, 480, (338.563, 338.939, 336.455, 230.487))
    expected = {"02": {"22", "24", "85", "198"}, "04": {"58", "85", "144"}, "06": {"58", "85", "144"}}
    for number, ids in expected.items():
        found = TagDetector(lens).detect(photo(f"test_image_multiple_{number}.png"), 0)
        assert {s.id for s in found} == ids
        assert min(s.agreement for s in found) > 0.95  # real ink on real paper


def test_real_photos_give_the_turn_of_the_table():
    lens = Camera.create("radtan", 1056, 792, (329.873, 332.946, 528.0, 396.0))
    attitude = {}
    for degrees in (-60, -40, -20, 0, 20, 40, 60):
        (found,) = TagDetector(lens).detect(photo(f"test_image_rotation_{degrees}.png"), 0)
        assert found.id == "76"
        attitude[degrees] = tag_poses(found, 0.065, lens)[0].T_cam_tag.R
    for degrees, R in attitude.items():
        turned = np.degrees(rotation_angle(attitude[0].T @ R))
        assert turned == pytest.approx(
            abs(degrees), abs=4.0
        )  # the table was turned by hand, the lens has no distortion
