"""One camera and an IMU on a drone, real: it starts in flight, maps, and the whole is adjusted at the end."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import shared_data
from lodelight.evaluation.compare import compare
from lodelight.io.sources import open_source
from lodelight.messages import Estimate
from lodelight.slam import Slam, SlamConfig

END_S = 4.5


@pytest.fixture(scope="module")
def flown() -> tuple[Slam, list[Estimate]]:
    recording = open_source(shared_data("euroc_mh05"))
    slam = Slam(recording.rig, SlamConfig(sensors="mono-inertial"))
    return slam, list(slam.run(recording, 0.0, END_S))


def test_it_starts_in_flight_and_then_knows_every_frame(flown):
    _, estimates = flown
    first = next(i for i, e in enumerate(estimates) if e.localized)
    assert (estimates[first].t_ns - estimates[0].t_ns) * 1e-9 <= 2.0
    assert all(e.localized for e in estimates[first:])
    assert all(e.why for e in estimates[:first])
    last = estimates[-1].details
    bias = np.array([last[f"bias_gyro_{axis}"] for axis in "xyz"])
    assert np.allclose(bias, [-0.002, 0.021, 0.077], atol=0.006)  # what the other recordings of this IMU have


def test_the_map_is_upright_and_its_path_is_that_of_the_drone(flown):
    """Three seconds and two metres: a monocular scale is still open by percents."""
    slam, _ = flown
    truth = open_source(shared_data("euroc_mh05")).ground_truth()
    assert truth is not None
    path = slam.trajectory()
    assert compare(path, truth, "sim3").ate.rmse_m < 0.03
    found = compare(path, truth, "yaw")
    assert found.ate.rmse_m < 0.25
    assert found.ate.rotation_deg < 2.5
    assert len(slam.map.alive_keyframes) >= 8
    assert len(slam.inertial.flown.entries) > len(slam.map.alive_keyframes)
