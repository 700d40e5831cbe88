"""What a new user runs first, and the systems in buildings whose truth is exact."""

import json

import numpy as np
import pytest

from lodelight.cli.main import main
from lodelight.cli.run import slam_to_folder
from lodelight.evaluation.associate import matched
from lodelight.evaluation.nees import nees
from lodelight.io import open_source
from lodelight.io.covariances import read_covariances
from lodelight.io.trajectories import read_trajectory
from lodelight.slam import SlamConfig
from lodelight.trajectory import Trajectory


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module", params=[("stereo", "office"), ("rgbd", "carpark")], ids=lambda p: p[0])
def visual(request, demo):
    """(out folder, truth) of a run over a recording of the demo, with cameras alone."""
    sensors, building = request.param
    slam_to_folder(open_source(demo / building), demo / sensors, SlamConfig(sensors=sensors))
    return demo / sensors, open_source(demo / building).ground_truth()


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_the_demo_is_exact_to_centimetres_with_an_imu_and_writes_its_report(demo):
    metrics = metrics_of(demo / "inertial")
    assert metrics["tracked_fraction"] > 0.9  # its first second finds out where down is
    assert metrics["ate"]["final"]["rmse_m"] < 0.03  # images of a quarter of the usual area, seen at 15 Hz
    assert metrics["ate"]["final"]["rotation_deg"] < 1.5
    assert (demo / "inertial" / "report.html").stat().st_size > 100_000


def test_the_demo_lies_where_its_lights_hang(demo):
    metrics = metrics_of(demo / "lights")
    assert metrics["tracked_fraction"] > 0.9  # the map begins with the first lights
    assert metrics["gate"]["pass"] > 5
    assert metrics["ate"]["final"]["rmse_m"] < 0.06  # without any alignment


def test_the_demo_finds_another_camera_in_the_map(demo):
    metrics = metrics_of(demo / "localize")
    assert metrics["tracked_fraction"] >= 0.95
    assert metrics["temporary_points"]["left"] == 0
    assert metrics["ate"]["final"]["rmse_m"] < 0.03


def test_cameras_alone_are_exact_to_three_centimetres_and_lose_no_frame(visual):
    metrics = metrics_of(visual[0])
    assert metrics["tracked_fraction"] == 1.0
    assert metrics["ate"]["final"]["rmse_m"] < 0.03  # the car park's path is so straight that any turn about it fits


def test_the_scale_of_a_map_is_that_of_the_building(visual):
    estimate, true = matched(read_trajectory(visual[0] / "trajectory.tum"), visual[1])
    ratio = (
        np.linalg.norm(np.diff(true.xyz[::10], axis=0), axis=1).sum()
        / np.linalg.norm(np.diff(estimate.xyz[::10], axis=0), axis=1).sum()
    )
    assert ratio == pytest.approx(1.0, abs=0.02)


def test_errors_are_of_the_size_that_covariances_say(visual):
    live = read_trajectory(visual[0] / "trajectory_live.tum")
    estimate, truth = matched(live, visual[1])
    # the map's origin is its first keyframe, whose pose is exact by definition
    T_map_world = estimate.pose(0) @ truth.pose(0).inverse()
    aligned = Trajectory.from_poses(truth.t_ns.tolist(), [T_map_world @ truth.pose(i) for i in range(len(truth))])
    _, covariance = read_covariances(visual[0] / "covariance.csv")
    result = nees(estimate, aligned, covariance)
    # one path of one building: errors of a drifting map are one draw, not many
    assert 0.02 < result.pose < 4.0
