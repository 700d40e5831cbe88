"""A lens found again from pictures of a printed board, by an independent ray caster."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodelight.cli.main import main
from lodelight.errors import CalibrationError
from lodelight.fiducials import fiducial_modules
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.rig_toml import read_rig
from lodelight.tagboard import TagBoard
from lodelight.tags.calibrate import BoardView, calibrate, find_board
from tag_scenes import Print, picture

BOARD = TagBoard("tag36h11", 5, 5, 0.032, 0.008)  # a module is 4 mm, a gap two
LENSES = {
    "radtan": Camera.create("radtan", 480, 360, (315.0, 319.0, 232.0, 184.0), (-0.25, 0.06, 5e-4, -3e-4)),
    "equidistant": Camera.create("equidistant", 480, 360, (190.0, 191.0, 244.0, 178.0), (0.02, -0.01, 0.004, -0.001)),
}
NEAR_M = {"radtan": 0.28, "equidistant": 0.18}


def whole_board() -> np.ndarray:
    """(48, 48) modules of the board."""
    sheet = np.ones((48, 48), np.uint8)
    for number in BOARD.numbers:
        row, column = divmod(number, BOARD.columns)
        sheet[10 * row : 10 * row + 8, 10 * column : 10 * column + 8] = fiducial_modules(BOARD.family, number)
    return sheet


def poses(camera: Camera, n: int, near: float, tilted: bool = True, seed: int = 0):
    """T_cam_board, its middle before all parts of a camera, tilted up to 40 degrees."""
    rng = np.random.default_rng(seed)
    spots = [(x, y) for y in (0.25, 0.5, 0.75) for x in (0.2, 0.5, 0.8)]
    for k in range(n):
        u = np.array(spots[k % len(spots)]) * (camera.width, camera.height) + rng.uniform(-15, 15, 2)
        ray = camera.unproject(u[None])[0][0]
        turn = rng.uniform(-0.7, 0.7, 3) * (1, 1, 0.5) if tilted else rng.uniform(-0.01, 0.01, 3)
        yield SE3.exp(np.array([*turn, *(ray * rng.uniform(near, 1.8 * near))]))


@pytest.fixture(scope="module")
def images():
    """Twelve pictures by each lens."""
    sheet, out = whole_board(), {}
    for model, camera in LENSES.items():
        board = [Print(sheet, T, 48 * 0.004) for T in poses(camera, 12, NEAR_M[model])]
        out[model] = [picture(camera, [b], seed=k, fine=2) for k, b in enumerate(board)]
    return out


def exact_views(camera: Camera, n: int, tilted: bool) -> list[BoardView]:
    """What a perfect detector would see, the whole board each time."""
    middle, numbers = np.array([0.096, 0.096, 0.0]), np.array(BOARD.numbers, np.int32)
    corners = np.array([BOARD.corners(number) for number in BOARD.numbers]) - middle
    return [
        BoardView(str(k), numbers, camera.project(T @ corners.reshape(-1, 3))[0].reshape(-1, 4, 2))
        for k, T in enumerate(poses(camera, n, 0.4, tilted))
    ]


@pytest.mark.parametrize("model", ["radtan", "equidistant"])
def test_a_lens_is_found_again(model, images):
    camera = LENSES[model]
    views, size, count = find_board(((str(i), image) for i, image in enumerate(images[model])), BOARD)
    assert (size, count) == ((480, 360), 12)
    found = calibrate(views, size, BOARD, model)
    assert found.rms_px < 0.25
    u, v = np.meshgrid(np.linspace(25, 454, 12), np.linspace(25, 334, 9))
    px = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, seen = camera.unproject(px)
    back, _ = found.camera.project(rays[seen])
    assert np.abs(found.camera.params[:2] / camera.params[:2] - 1.0).max() < 0.01
    error = np.linalg.norm(back - px[seen], axis=1)
    assert np.median(error) < 0.5
    assert error.max() < 2.0  # at the rim, where the board was seen least


def test_the_command_writes_a_rig(tmp_path, capsys, images):
    folder = tmp_path / "images"
    folder.mkdir()
    for i, image in enumerate(images["radtan"]):
        cv2.imwrite(str(folder / f"{i:02d}.png"), image)
    args = ["calibrate", str(folder), "--board", str(BOARD), "--out", str(tmp_path / "rig.toml"), "--json"]
    assert main(args) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["views"] >= 8
    assert len(told["regions_px"]) == 3
    camera = read_rig(tmp_path / "rig.toml").cameras[0].camera
    assert camera.params[:4] == pytest.approx(told["intrinsics"])
    assert camera.params[0] == pytest.approx(315.0, rel=0.01)


def test_views_that_say_too_little_are_refused(tmp_path, capsys):
    camera, size = LENSES["radtan"], (480, 360)
    good = exact_views(camera, 9, tilted=True)
    assert calibrate(good, size, BOARD).rms_px < 0.01
    with pytest.raises(CalibrationError, match="8 are needed"):
        calibrate(good[:7], size, BOARD)
    with pytest.raises(CalibrationError, match="tilt the board"):
        calibrate(exact_views(camera, 9, tilted=False), size, BOARD)
    with pytest.raises(CalibrationError, match="into the corners"):
        calibrate([replace(good[0], numbers=good[0].numbers[:8], px=good[0].px[:8])] * 9, size, BOARD)
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((480, 640), 90, np.uint8))
    assert main(["calibrate", str(tmp_path), "--out", str(tmp_path / "rig.toml")]) == 2
    assert "0 images show" in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path / "none"), "--out", str(tmp_path / "rig.toml")]) == 2
    assert main(["calibrate", str(tmp_path), "--model", "kb", "--out", str(tmp_path / "rig.toml")]) == 2
