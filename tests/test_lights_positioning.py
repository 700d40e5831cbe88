"""Positions from lights: exact without noise, consistent with it, and silent where they would be wrong."""

from dataclasses import replace

import numpy as np
import pytest

from light_scenes import SPEC, measured_up, random_pose, sightings
from lodelight.anchors import Light
from lodelight.errors import CalibrationError
from lodelight.geometry.se3 import SE3
from lodelight.lights.conic import disc_poses, image_of_disc
from lodelight.lights.level import Leveller
from lodelight.lights.odometry import LightOdometry
from lodelight.lights.sighted import assigned
from lodelight.lights.two_lights import poses_from_two_lights
from lodelight.messages import Imu

XY = {2: [(-0.6, 0.0), (0.6, 0.0)], 4: [(-0.6, -0.45), (0.6, -0.45), (0.6, 0.45), (-0.6, 0.45)]}


def ceiling(xy, z=2.2, sigma_m=2e-4):
    return tuple(Light(f"L{i}", 2000.0 + 200 * i, np.array([*p, z]), sigma_m=sigma_m) for i, p in enumerate(xy))


def error(fix, truth):
    turn = SE3(fix.T_world_body.R.T @ truth.R, np.zeros(3)).log()[:3]
    return np.concatenate([turn, truth.t - fix.T_world_body.t])


def test_two_lights_and_up_place_a_camera_exactly():
    rng = np.random.default_rng(0)
    for _ in range(50):
        T = random_pose(rng, 10.0) @ SPEC.T_body_cam
        xyz = np.column_stack([rng.uniform(-1, 1, (2, 2)), rng.uniform(2.0, 3.0, 2)])
        rays = (xyz - T.t) @ T.R
        found = poses_from_two_lights(rays, xyz, T.R[2])
        assert min(np.linalg.norm(p.matrix - T.matrix) for p in found) < 1e-9


def test_the_image_of_a_circle_gives_its_place_and_tilt_back():
    rng = np.random.default_rng(1)
    for _ in range(50):
        centre = np.array([*rng.uniform(-1, 1, 2), rng.uniform(1, 4)])
        normal = rng.normal(size=3)
        normal *= -np.sign(normal @ centre) / np.linalg.norm(normal)
        conic = np.linalg.inv(image_of_disc(centre, normal, 0.09))
        poses = disc_poses(0.5 * (conic + conic.T), 0.09)
        assert min(np.linalg.norm(c - centre) + np.linalg.norm(n - normal) for c, n in poses) < 1e-6


@pytest.mark.parametrize(("count", "rms_m", "rms_deg"), [(2, 0.02, 0.5), (4, 0.01, 0.3)])
def test_positions_and_their_covariances_with_known_noise(count, rms_m, rms_deg):
    rng = np.random.default_rng(2)
    lights, errors, nees = ceiling(XY[count]), [], []
    for _ in range(100):
        truth = random_pose(rng)
        odometry = LightOdometry(SPEC, lights, sigma_tilt_deg=0.25)
        fix = odometry.locate(sightings(truth, lights, rng), measured_up(truth, 0.25, rng))
        e = error(fix, truth)
        errors.append(e)
        nees.append(e @ np.linalg.solve(fix.covariance, e) / 6.0)
    e = np.array(errors)
    assert np.sqrt((e[:, 3:] ** 2).sum(axis=1).mean()) < rms_m
    assert np.degrees(np.sqrt((e[:, :3] ** 2).sum(axis=1).mean())) < rms_deg
    assert 0.8 < np.mean(nees) < 1.25  # of 600 degrees of freedom: 1 +- 0.06, and what sigma_m adds


def test_survey_errors_are_in_the_covariance():
    rng = np.random.default_rng(3)
    nees = []
    for _ in range(100):
        truth, true = random_pose(rng), ceiling(XY[4])
        surveyed = tuple(Light(t.id, t.frequency_hz, t.xyz + rng.normal(0.0, 0.005, 3)) for t in true)
        fix = LightOdometry(SPEC, surveyed, 0.25).locate(sightings(truth, true, rng), measured_up(truth, 0.25, rng))
        e = error(fix, truth)
        nees.append(e @ np.linalg.solve(fix.covariance, e) / 6.0)
    assert 0.8 < np.mean(nees) < 1.25


def test_a_wrong_light_is_left_out_of_four_and_breaks_three():
    rng = np.random.default_rng(4)
    truth, lights = random_pose(rng), ceiling(XY[4])
    seen = sightings(truth, lights, rng)
    moved = (Light("L0", 2000.0, lights[0].xyz + np.array([1.0, 0.0, 0.0]), sigma_m=2e-4), *lights[1:])
    fix = LightOdometry(SPEC, moved).locate(seen, truth.R[2])
    assert set(fix.lights) == {"L1", "L2", "L3"}
    assert np.linalg.norm(error(fix, truth)[3:]) < 0.03
    fix = LightOdometry(SPEC, moved).locate(seen[:3], truth.R[2])
    assert fix.T_world_body is None
    assert "do not fit" in fix.why


def test_a_mirrored_map_is_named():
    rng = np.random.default_rng(5)
    truth, lights = random_pose(rng), ceiling([(-0.6, -0.4), (0.7, -0.3), (0.5, 0.6), (-0.1, 0.2)])
    mirrored = tuple(Light(k.id, k.frequency_hz, k.xyz * [-1, 1, 1], sigma_m=2e-4) for k in lights)
    with pytest.raises(CalibrationError, match="mirror"):
        LightOdometry(SPEC, mirrored).locate(sightings(truth, lights, rng), truth.R[2])


def test_no_light_and_one_light_abstain():
    rng = np.random.default_rng(6)
    truth, lights = random_pose(rng), ceiling(XY[4])
    odometry = LightOdometry(SPEC, lights)
    assert odometry.locate([], truth.R[2]).why == "no light named"
    alone = odometry.locate(sightings(truth, lights[:1], rng), truth.R[2])
    assert alone.T_world_body is None
    assert "one light" in alone.why


def test_lights_of_one_code_are_told_apart_by_their_neighbours():
    rng = np.random.default_rng(7)
    here = ceiling(XY[4])
    far = tuple(
        Light(f"F{i}", k.frequency_hz, k.xyz + np.array([9.0 + 3.0 * i, 2.0 * i * i, 0.0]), sigma_m=2e-4)
        for i, k in enumerate(here)
    )
    truth = random_pose(rng)
    names = [(a.id, b.id) for a, b in zip(here, far, strict=True)]
    fix = LightOdometry(SPEC, here + far).locate(sightings(truth, here, rng, names=names), truth.R[2])
    assert set(fix.lights) == {"L0", "L1", "L2", "L3"}
    assert np.linalg.norm(error(fix, truth)[3:]) < 0.03


def test_two_places_that_look_the_same_abstain():
    rng = np.random.default_rng(8)
    here = ceiling(XY[4])
    again = tuple(
        Light(f"F{i}", k.frequency_hz, k.xyz + np.array([9.0, 0.0, 0.0]), sigma_m=2e-4) for i, k in enumerate(here)
    )
    truth = random_pose(rng)
    names = [(a.id, b.id) for a, b in zip(here, again, strict=True)]
    fix = LightOdometry(SPEC, here + again).locate(sightings(truth, here, rng, names=names), truth.R[2])
    assert fix.T_world_body is None
    assert "more than one place" in fix.why


def test_a_code_used_once_names_its_light_and_one_used_again_only_the_nearest():
    lights = {k.id: k for k in ceiling([(0.0, 0.0), (5.0, 0.0), (14.0, 0.0)])}
    T = SE3.identity() @ SPEC.T_body_cam
    for x, names, expected in (
        (0.9, ("L1",), "L1"),  # 4.1 m from its survey
        (0.9, ("L0", "L2"), "L0"),
        (0.9, ("L0", "L1"), "L0"),
        (-2.4, ("L0", "L1"), "L0"),
        (1.9, ("L0", "L1"), None),  # 1.9 and 3.1 m
    ):
        (seen,) = sightings(
            SE3.identity(),
            [replace(lights["L0"], xyz=np.array([x, 0.0, 2.2]))],
            np.random.default_rng(0),
            names=[names],
        )
        found = assigned(seen, T, SPEC.camera, lights)
        assert (found and found.id) == expected


@pytest.mark.parametrize("bias", [(0.0, 0.0, 0.0), (0.02, -0.03, 0.01)])
def test_up_follows_a_turning_body_and_finds_the_gyros_bias(bias):
    leveller, rng = Leveller(), np.random.default_rng(9)
    R, dt, off, said = np.eye(3), 0.005, [], []
    for k in range(4000):
        gyro = np.array([0.2 * np.cos(0.01 * k), 0.1, 0.3])
        moved = 1.0 * np.sin([0.06 * k, 0.05 * k, 0.1 * k]) + 0.05 * rng.normal(size=3)  # m/s^2, steps
        leveller.feed(Imu(round(k * dt * 1e9), gyro + bias, R.T @ (np.array([0.0, 0.0, 9.81]) + moved)))
        if k >= 2000:
            off.append(np.arccos(min(1.0, leveller.up_body @ R[2])))
            said.append(leveller.sigma_rad)
        R = R @ SE3.exp(np.array([*(gyro * dt), 0, 0, 0])).R
    assert np.degrees(np.sqrt(np.mean(np.square(off)))) < 1.0
    assert np.mean(np.square(off)) < 2.0 * 9.0 * np.mean(np.square(said))  # two axes, three sigmas
