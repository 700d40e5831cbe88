"""Positions by lights as odometry files: out and in again, and what is said of bad ones."""

from dataclasses import replace

import numpy as np
import pytest

from lodelight.errors import CalibrationError, SourceError
from lodelight.geometry.se3 import SE3, carried_covariance
from lodelight.io.covariances import covariance_from_ros, covariance_to_ros, write_covariances
from lodelight.io.light_odometry import check_clock, read_light_odometry
from lodelight.io.odometry_bag import TOPIC, read_odometry_bag, write_odometry
from lodelight.io.trajectories import write_tum
from lodelight.messages import LightFix
from lodelight.sim.rigs import standard
from lodelight.trajectory import Trajectory

RIG = standard()
START_NS = 1_600_000_000_123_456_789


def fixes(count=5):
    rng = np.random.default_rng(0)
    made = []
    for i in range(count):
        A = rng.normal(size=(6, 6)) * [0.01, 0.01, 0.02, 0.1, 0.1, 0.05]
        made.append(LightFix(START_NS + i * 100_000_000, SE3.exp(rng.normal(size=6)), A.T @ A, ("L1", "L2"), 0.4))
    return made


def test_a_ros_covariance_is_that_of_a_turn_about_fixed_axes():
    """Sampled: bodies perturbed in our chart, their turns read along the header's axes."""
    rng = np.random.default_rng(1)
    T = SE3.exp(np.array([0.4, -1.1, 2.0, 1.0, 2.0, 3.0]))
    ours = np.diag([1e-6, 4e-6, 9e-6, 1e-4, 4e-4, 9e-4])
    rows = []
    for d in rng.normal(size=(20_000, 6)) * np.sqrt(np.diag(ours)):
        moved = T.perturbed(d)
        rows.append([*(moved.t - T.t), *SE3(moved.R @ T.R.T, np.zeros(3)).log()[:3]])
    expected = covariance_to_ros(T.R, ours)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    # 20,000 samples: 1 % of a variance, three times that for the worst of 36
    assert (np.abs(np.cov(np.array(rows).T) - expected) / scale).max() < 0.03
    np.testing.assert_allclose(covariance_from_ros(T.R, expected), ours, atol=1e-18)


@pytest.mark.parametrize("name", ["lights.mcap", "lights.bag"])
def test_a_bag_gives_back_what_was_written(tmp_path, name):
    made = [*fixes(), LightFix(START_NS + 10**9, None, np.full((6, 6), np.inf), why="one light only")]
    write_odometry(tmp_path / name, made)
    write_odometry(tmp_path / name, made)  # replaces what is there
    assert {(r.frame_id, r.child_frame_id) for r in read_odometry_bag(tmp_path / name)} == {("world", "body")}
    for text in (str(tmp_path / name), f"{tmp_path / name}:{TOPIC}"):
        back = read_light_odometry(text, RIG)
        assert [f.t_ns for f in back] == [f.t_ns for f in made[:-1]]
        for a, b in zip(made, back, strict=False):
            np.testing.assert_allclose(b.T_world_body.matrix, a.T_world_body.matrix, atol=1e-12)
            np.testing.assert_allclose(b.covariance, a.covariance, atol=1e-14)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_poses_of_the_light_camera_come_to_the_body(tmp_path):
    made = fixes()
    T = RIG.lights.T_body_cam
    of_camera = []
    for f in made:
        there = f.T_world_body @ T
        of_camera.append(
            replace(f, T_world_body=there, covariance=carried_covariance(f.T_world_body, f.covariance, there))
        )
    write_odometry(tmp_path / "lights.mcap", of_camera, body="light0")
    for a, b in zip(made, read_light_odometry(str(tmp_path / "lights.mcap"), RIG), strict=True):
        np.testing.assert_allclose(b.T_world_body.matrix, a.T_world_body.matrix, atol=1e-12)
        np.testing.assert_allclose(b.covariance, a.covariance, atol=1e-12)
    with pytest.raises(CalibrationError, match=r"\[lights\]"):
        read_light_odometry(str(tmp_path / "lights.mcap"), replace(RIG, lights=None))
    write_odometry(tmp_path / "other.mcap", of_camera, body="forklift")
    with pytest.raises(CalibrationError, match="forklift"):
        read_light_odometry(str(tmp_path / "other.mcap"), RIG)


def test_text_with_its_covariances(tmp_path):
    made = fixes()
    write_tum(
        tmp_path / "trajectory.tum", Trajectory.from_poses([f.t_ns for f in made], [f.T_world_body for f in made])
    )
    write_covariances(tmp_path / "covariance.csv", [f.t_ns for f in made], [f.covariance for f in made])
    for a, b in zip(made, read_light_odometry(str(tmp_path / "trajectory.tum"), RIG), strict=True):
        assert b.t_ns == a.t_ns
        np.testing.assert_allclose(b.T_world_body.matrix, a.T_world_body.matrix, atol=1e-8)
        np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-12)


def test_poses_that_are_none_abstain_with_their_reason(tmp_path):
    file = tmp_path / "odometry.tum"
    file.write_text("1.0 0 0 0 0 0 0 1\n1.1 0 0 0 0 0 0 0.5\n1.2 nan 0 0 0 0 0 1\n1.3 0 0 0 nan 0 0 1\n")
    back = read_light_odometry(str(file), RIG)
    assert [f.T_world_body is None for f in back] == [False, True, True, True]
    assert "length 0.5" in back[1].why
    assert "not finite" in back[2].why
    assert "not finite" in back[3].why


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1.0 0 0 0 0 0 0 0\n", "no pose that can be used"),
        ("", "no pose that can be used"),
        ("1.0 0 0\n", "line 1"),
        ("one 0 0 0 0 0 0 1\n", "line 1"),
    ],
)
def test_text_that_is_no_odometry(tmp_path, text, words):
    (tmp_path / "odometry.tum").write_text(text)
    with pytest.raises(SourceError, match=words):
        read_light_odometry(str(tmp_path / "odometry.tum"), RIG)


def test_bags_that_cannot_serve(tmp_path):
    with pytest.raises(SourceError, match="does not exist"):
        read_light_odometry(str(tmp_path / "none.bag"), RIG)
    (tmp_path / "broken.bag").write_bytes(b"not a bag")
    with pytest.raises(SourceError, match="cannot be read"):
        read_light_odometry(str(tmp_path / "broken.bag"), RIG)
    write_odometry(tmp_path / "lights.bag", fixes())
    with pytest.raises(SourceError, match=TOPIC):
        read_light_odometry(f"{tmp_path / 'lights.bag'}:/other", RIG)
    write_odometry(tmp_path / "odom.bag", fixes(), world="odom")
    with pytest.raises(SourceError, match="'odom'"):
        read_light_odometry(str(tmp_path / "odom.bag"), RIG)


def test_another_clock_is_named():
    made = fixes()
    check_clock(made, (START_NS - 10**9, START_NS + 10**9), "lights.bag")
    with pytest.raises(SourceError, match=r"3600\.000 s after"):
        check_clock(made, (START_NS - 3600 * 10**9, START_NS - 3590 * 10**9), "lights.bag")
