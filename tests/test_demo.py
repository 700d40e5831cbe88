"""What a new user runs first, and the whole system on a building whose truth is exact."""

import json

import numpy as np
import pytest

from lodelight.cli.main import main


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize("sensors", ["rgbd", "stereo"])
def test_the_demo_is_exact_to_three_centimetres_and_loses_no_frame(demo, sensors):
    metrics = json.loads((demo / sensors / "metrics.json").read_text())
    assert metrics["tracked_fraction"] == 1.0
    assert metrics["ate"]["final"]["rmse_m"] < 0.03  # images of a quarter of the usual area, seen at 15 Hz
    assert metrics["ate"]["final"]["rotation_deg"] < 1.5
    assert (demo / sensors / "report.html").stat().st_size > 100_000


def test_the_demo_finds_another_camera_in_the_stereo_map(demo):
    metrics = json.loads((demo / "localize" / "metrics.json").read_text())
    assert metrics["tracked_fraction"] >= 0.95
    assert metrics["temporary_points"]["left"] == 0


def test_the_demo_finds_another_camera_to_three_centimetres(demo):
    metrics = json.loads((demo / "localize" / "metrics.json").read_text())
    assert metrics["ate"]["final"]["rmse_m"] < 0.03


def test_the_scale_of_a_stereo_map_is_that_of_the_building(demo):
    from lodelight.evaluation.associate import matched
    from lodelight.io import open_source
    from lodelight.io.trajectories import read_trajectory

    truth = open_source(demo / "office").ground_truth()
    estimate, true = matched(read_trajectory(demo / "stereo" / "trajectory.tum"), truth)
    ratio = (
        np.linalg.norm(np.diff(true.xyz[::10], axis=0), axis=1).sum()
        / np.linalg.norm(np.diff(estimate.xyz[::10], axis=0), axis=1).sum()
    )
    assert ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("sensors", ["rgbd", "stereo"])
def test_errors_are_of_the_size_that_covariances_say(demo, sensors):
    from lodelight.evaluation.associate import matched
    from lodelight.evaluation.nees import nees
    from lodelight.io import open_source
    from lodelight.io.covariances import read_covariances
    from lodelight.io.trajectories import read_trajectory
    from lodelight.trajectory import Trajectory

    live = read_trajectory(demo / sensors / "trajectory_live.tum")
    estimate, truth = matched(live, open_source(demo / "office").ground_truth())
    # the map's origin is its first keyframe, whose pose is exact by definition
    T_map_world = estimate.pose(0) @ truth.pose(0).inverse()
    aligned = Trajectory.from_poses(truth.t_ns.tolist(), [T_map_world @ truth.pose(i) for i in range(len(truth))])
    _, covariance = read_covariances(demo / sensors / "covariance.csv")
    result = nees(estimate, aligned, covariance)
    # one path of one building: errors of a drifting map are one draw, not many
    assert 0.02 < result.pose < 4.0
