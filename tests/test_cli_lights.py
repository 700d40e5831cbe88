"""`lodelight lights`, on a small recording of simulated light images."""

import json
import shutil

import numpy as np
import pytest

from light_scenes import ROW_S, SPEC, UP, crop, paint
from lodelight.anchors import Anchors, Light
from lodelight.cli import main as cli
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.anchors_toml import read_anchors, write_anchors
from lodelight.io.euroc_writer import TRUTH, append_image, write_sensors
from lodelight.io.rig_toml import write_rig
from lodelight.io.sources import open_source
from lodelight.io.trajectories import read_trajectory
from lodelight.lights.modulation import Pwm
from lodelight.rig import CameraSpec, Rig

LIGHTS = tuple(
    Light(f"L{i}", 3000.0 + 600.0 * i, np.array([x, y, 2.5]))
    for i, (x, y) in enumerate([(-0.6, -0.4), (0.7, -0.3), (0.5, 0.5)])
)
RIG = Rig(
    (CameraSpec("cam0", Camera.create("radtan", 64, 48, (50.0, 50.0, 31.5, 23.5)), SE3(UP, np.zeros(3))),), lights=SPEC
)


@pytest.fixture
def recording(tmp_path):
    """Three frames of a body that stands level at (0.1, -0.05, 0.2)."""
    rng = np.random.default_rng(0)
    folder = tmp_path / "rec"
    folders = write_sensors(folder, RIG, "")
    shutil.rmtree(folders[TRUTH])
    T = SE3(np.eye(3), np.array([0.1, -0.05, 0.2])) @ SPEC.T_body_cam
    for k in range(3):
        t_ns = 1_000_000_000 + 100_000_000 * k
        discs = []
        for light in LIGHTS:
            X = T.R.T @ (light.xyz - T.t)
            px, _ = SPEC.camera.project(X[None])
            discs.append((px[0], 2.0 * light.radius_m * 1000.0 / X[2], Pwm(light.frequency_hz, 0.5, rng.uniform())))
        append_image(folders["light0"], t_ns, paint((960, 1280), discs, rng))
        append_image(folders["cam0"], t_ns, np.zeros((48, 64), np.uint8))
    write_anchors(tmp_path / "anchors.toml", Anchors(lights=LIGHTS))
    return folder


def test_decode_writes_where_the_body_was(recording, tmp_path, capsys):
    out = tmp_path / "out"
    call = ["lights", "decode", str(recording), "--anchors", str(tmp_path / "anchors.toml"), "--out", str(out)]
    assert cli.main([*call, "--level", "mounting", "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert (metrics["frames"], metrics["fixes"], metrics["named"]) == (3, 3, 9)
    path = read_trajectory(out / "trajectory.tum")
    # Level to 1e-4 and 0.05 px of 2.3 m: a millimetre or two
    np.testing.assert_allclose(path.xyz, [[0.1, -0.05, 0.2]] * 3, atol=3e-3)
    assert {p.name for p in out.iterdir()} == {
        "trajectory.tum", "covariance.csv", "odometry.mcap", "odometry.bag", "fixes.csv", "sightings.csv",
        "metrics.json", "frame.png",
    }  # fmt: skip


def test_light_frames_are_streamed_with_their_stamps(recording):
    frames = list(open_source(recording).light_frames())
    assert [f.t_ns for f in frames] == [1_000_000_000, 1_100_000_000, 1_200_000_000]
    assert frames[0].images[0].shape == (960, 1280)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: write_anchors(p / "anchors.toml", Anchors()), "name no light"),
        (lambda p: (p / "anchors.toml").unlink(), "anchors.toml"),
        (lambda p: (p / "rec" / "mav0" / "light0" / "data.csv").unlink(), "light camera"),
    ],
)
def test_what_is_missing_is_said_in_a_line(recording, tmp_path, capsys, change, words):
    change(tmp_path)
    call = [
        "lights",
        "decode",
        str(recording),
        "--anchors",
        str(tmp_path / "anchors.toml"),
        "--out",
        str(tmp_path / "o"),
    ]
    assert cli.main([*call, "--level", "mounting"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert words in err


def test_unknown_frequencies_place_nothing_and_say_so(recording, tmp_path, capsys):
    others = tuple(Light(k.id, k.frequency_hz + 300.0, k.xyz) for k in LIGHTS)
    write_anchors(tmp_path / "anchors.toml", Anchors(lights=others))
    call = [
        "lights",
        "decode",
        str(recording),
        "--anchors",
        str(tmp_path / "anchors.toml"),
        "--out",
        str(tmp_path / "o"),
    ]
    assert cli.main([*call, "--level", "mounting"]) == 1
    assert "no frame gave a position" in capsys.readouterr().err
    assert "no light's" in (tmp_path / "o" / "sightings.csv").read_text()


def test_plan_and_calibrate(tmp_path, capsys):
    import cv2

    write_rig(tmp_path / "rig.toml", RIG)
    (tmp_path / "lights.txt").write_text("A 0 0 2.8\nB 1.5 0 2.8 0.1\nC 3 0 2.8\n")
    call = ["lights", "plan", str(tmp_path / "lights.txt"), "--rig", str(tmp_path / "rig.toml")]
    assert cli.main([*call, "--out", str(tmp_path / "planned.toml"), "--json"]) == 0
    planned = read_anchors(tmp_path / "planned.toml").lights
    assert len({light.frequency_hz for light in planned}) == 3
    assert (tmp_path / "planned.csv").read_text().count("\n") == 4
    capsys.readouterr()
    cv2.imwrite(str(tmp_path / "one.png"), crop(np.random.default_rng(1), 90, 3000.0)[0])
    assert cli.main(["lights", "calibrate", str(tmp_path / "one.png"), "--frequency", "3000", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["row_time_s"] == pytest.approx(ROW_S, rel=2e-3)
