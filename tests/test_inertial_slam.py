"""One camera and an IMU on a drone, real: it starts in flight, maps, and the whole is adjusted at the end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from conftest import shared_data
from light_scenes import SPEC, along
from lodelight.anchors import Anchors, Light
from lodelight.evaluation.compare import compare
from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.io.sources import open_source
from lodelight.mapping.compact import compacted
from lodelight.mapping.local import LocalMapper, LocalMappingConfig
from lodelight.mapping.map import Map
from lodelight.messages import Estimate
from lodelight.settings import with_settings
from lodelight.slam import Slam, SlamConfig
from maps import room_rig

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
    assert len(slam.inertial.flown.legs) == len(slam.map.alive_keyframes)


def test_in_its_own_map_it_is_found_again_and_stays_there_without_writing(flown):
    first, _ = flown
    recording, known = open_source(shared_data("euroc_mh05")), compacted(first.map)
    before = [table.columns["R"].copy() for table in (known.keyframes, known.loops)], len(known.points)
    slam = Slam(recording.rig, SlamConfig(sensors="mono-inertial", final_iterations=0), map=known)
    slam.localization_only = True
    found = [e for e in slam.run(recording, 1.5, END_S) if e.localized]
    path = first.trajectory()
    row = {int(t): i for i, t in enumerate(path.t_ns)}
    apart_m = [np.linalg.norm(e.T_world_body.t - path.xyz[row[e.t_ns]]) for e in found if e.t_ns in row]
    assert len(apart_m) > 15
    assert np.sqrt(np.mean(np.square(apart_m))) < 0.05  # of a path of 4 m at 8 m from what is seen
    assert slam.stats()["relocalizations"] == 1
    assert len(known.points) == before[1]
    for was, table in zip(before[0], (known.keyframes, known.loops), strict=True):
        assert np.array_equal(was, table.columns["R"])


@pytest.mark.parametrize(("with_imu", "newer", "left"), [(True, 6, False), (True, 5, True), (False, 6, True)])
def test_an_old_keyframe_does_not_stay_for_points_that_hardly_another_sees(with_imu, newer, left):
    """20 of its points are seen by all, 10 by one more keyframe at most."""
    map = Map(room_rig())
    n = 30
    px = np.column_stack([np.linspace(20.0, 600.0, n), np.full(n, 200.0)]).astype(np.float32)
    zero = np.zeros(n, np.float32)
    ray, _ = map.rig.cameras[0].camera.unproject(px)
    seen = Features(px, np.zeros(n, np.int32), zero, np.zeros((n, 4), np.uint64), ray, zero, zero)
    for k in range(newer + 2):
        map.add_keyframe(k, SE3.identity(), seen, parent=k - 1)
    rows = [np.arange(k * n, (k + 1) * n, dtype=np.int32) for k in range(newer + 2)]
    points = map.add_points(np.tile([0.0, 0.0, 3.0], (n, 1)), rows[1], 1)
    map.link(rows[2][20:25], points[20:25])
    for k in (0, *range(2, newer + 2)):
        map.link(rows[k][:20], points[:20])
    mapper = LocalMapper(map, OrbConfig(), LocalMappingConfig(window=5))
    mapper.hold_poses = with_imu
    mapper._cull_keyframes(newer + 1)
    assert map.keyframes.alive[1] == left


def upright(up):
    """(3, 3) R_body_cam of a camera that looks along a direction of the body."""
    across = np.linalg.svd(up[None])[2][1:]
    R = np.column_stack([across[0], np.cross(up, across[0]), up])
    return R


@pytest.mark.parametrize(("use", "within_m", "within_deg"), [("gate", 0.15, 1.5), ("tight", 0.05, 1.0)])
def test_lights_lay_its_map_down_in_the_world(use, within_m, within_deg):
    """Two metres, of which one camera knows the length to a tenth: the gate holds keyframes more loosely."""
    recording = open_source(shared_data("euroc_mh05"))
    truth = recording.ground_truth()
    assert truth is not None
    here = truth.rows((truth.t_ns > recording.span_ns[0]) & (truth.t_ns < recording.span_ns[0] + int(END_S * 1e9)))
    above = here.xyz.mean(axis=0) + np.array([0.0, 0.0, 3.0])
    lights = tuple(
        Light(str(i), 2000.0 + 200.0 * i, above + np.array([1.5 * (i % 6) - 3.75, 1.5 * (i // 6) - 3.75, 0.0]))
        for i in range(36)
    )
    spec = replace(SPEC, T_body_cam=SE3(upright(here.pose(len(here) // 2).R.T[:, 2]), np.zeros(3)))
    rig = replace(recording.rig, lights=spec)
    fixes = along(here, lights, spec, np.random.default_rng(0))
    config = with_settings(
        SlamConfig(sensors="mono-inertial"), ["gate.use=lights"] if use == "gate" else ["lights.use=tight"]
    )
    slam = Slam(rig, config, anchors=Anchors(lights=lights))
    for _ in slam.run(recording, 0.0, END_S, fixes):
        pass
    in_world = compare(slam.trajectory(), truth, "none")
    assert slam.lights.aligned
    assert in_world.ate.rmse_m < within_m
    assert in_world.ate.rotation_deg < within_deg
    if use == "gate":
        assert slam.stats()["gate"]["pass"] > 0
