"""A camera with an IMU in a map: its motion between frames, in darkness and in fast turns."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from corridors import ORB, OTHER, Corridor
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_log
from lodelight.localization.ladder import Ladder, LadderConfig
from lodelight.localization.reckoning import DeadReckoning
from lodelight.messages import Imu
from lodelight.rig import ImuSpec
from lodelight.sim.imu import TURN_ON, read_out
from lodelight.sim.motion import Motion
from lodelight.trajectory import Trajectory

S = 10**9
SPEC = ImuSpec()
TIPPED = SE3.exp(np.array([0.4, -0.3, 1.0, 5.0, -2.0, 1.0]))  # T_map_world: a map whose z is not up
SIGMA_RAD, SIGMA_M = 0.002, 0.005  # of poses found in the map


def flown(seed, yaw, duration_s=8.0):
    """The motion of a body in the corridor at 0.8 m/s with yaw(t_s), and what its IMU says."""
    t = np.arange(0.0, duration_s + 0.05, 0.05)
    poses = [
        SE3.exp(np.array([0.1 * np.sin(1.1 * s), 0.08 * np.cos(s), yaw(s), 2 + 0.8 * s, 0.3 * np.sin(0.9 * s), 1.4]))
        for s in t
    ]
    motion = Motion.fit(Trajectory.from_poses([round(s * S) for s in t], poses))
    imu = read_out(motion, SPEC, np.random.default_rng(seed), TURN_ON["euroc"])
    return motion, imu, [Imu(int(s), g, a) for s, g, a in zip(imu.t_ns, imu.gyro, imu.accel, strict=True)]


def at(motion, t_ns):
    return motion.at_ns(np.array([t_ns])).poses()[0]


def frames(samples, duration_s):
    """Every 0.1 s from 0.3 s on: the stamp of a frame, and the samples since the one before it."""
    stamps = [round(0.1 * k * S) for k in range(3, int(10 * duration_s))]
    for before, t_ns in itertools.pairwise([-1, *stamps]):
        yield t_ns, [s for s in samples if before < s.t_ns <= t_ns]


@pytest.fixture(scope="module")
def dark():
    """Errors, covariances and bias errors of a second in the dark after four of poses, by seed."""
    out = []
    for seed in range(12):
        motion, imu, samples = flown(seed, lambda s: 0.5 * np.sin(1.5 * s), 5.2)
        rng, reckoning = np.random.default_rng(seed + 50), DeadReckoning(SPEC)
        for t_ns, new in frames(samples, 5.2):
            for sample in new:
                reckoning.add(sample)
            T_map_body = TIPPED @ at(motion, t_ns)
            reckoned = reckoning.predict(t_ns)
            if t_ns <= 4 * S:
                noise = np.diag([SIGMA_RAD**2] * 3 + [SIGMA_M**2] * 3)
                found = T_map_body.perturbed(np.sqrt(np.diag(noise)) * rng.standard_normal(6))
                reckoning.correct(t_ns, found, noise)
        turned = so3_log(np.ascontiguousarray(reckoned.T_map_body.R.T @ T_map_body.R))
        error = np.concatenate([turned, T_map_body.t - reckoned.T_map_body.t])
        out.append((error, reckoned, reckoning.bias_gyro - imu.bias_gyro[-1], reckoning, T_map_body, t_ns))
    return out


def test_a_second_in_the_dark_is_reckoned_to_centimetres_and_the_covariance_says_so(dark):
    error = np.array([e for e, *_ in dark])
    assert np.median(np.linalg.norm(error[:, 3:], axis=1)) < 0.06
    assert np.degrees(np.linalg.norm(error[:, :3], axis=1)).max() < 1.0
    nees = np.array([e @ np.linalg.solve(r.covariance, e) for e, r, *_ in dark])
    assert 0.7 < nees.mean() < 6.0  # 6 / 4, as the noise of poses is taken for twice as much
    assert all(r.sigma_m < 0.2 for _, r, *_ in dark)


def test_the_gyroscopes_bias_is_found_from_poses(dark):
    assert np.linalg.norm([b for _, _, b, *_ in dark], axis=1).max() < 0.006


def test_a_pose_that_stands_off_the_vertical_is_told_whatever_way_the_map_lies(dark):
    for _, _, _, reckoning, T_map_body, t_ns in dark:
        tipped = T_map_body @ SE3.exp(np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
        assert reckoning.tipped_deg(t_ns, T_map_body) < 15.0
        assert reckoning.tipped_deg(t_ns, tipped) > 40.0


def test_samples_that_are_missing_leave_nothing_to_go_on():
    reckoning = DeadReckoning(SPEC)
    reckoning.begin(0, SE3.identity(), np.eye(6))
    assert reckoning.predict(S) is None
    for k in range(100):
        reckoning.add(Imu(k * S // 200, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    reckoning.correct(4 * S // 10, SE3.identity(), 1e-6 * np.eye(6))
    assert reckoning.predict(5 * S // 10) is not None
    assert reckoning.predict(2 * S) is None


def followed(inertial, dark_s, yaw):
    corridor = Corridor.built(0)
    motion, _, samples = flown(3, yaw)
    ladder = Ladder(
        OTHER, corridor.mapped(0), ORB, LadderConfig(), 0, True, False, lambda *_, **__: None,
        DeadReckoning(SPEC) if inertial else None,
    )  # fmt: skip
    rng, status, off_m = np.random.default_rng(1), [], []
    for t_ns, new in frames(samples, 8.0):
        for sample in new if inertial else ():
            ladder.reckoning.add(sample)
        T_world_body = at(motion, t_ns)
        seen, _ = corridor.seen(OTHER, T_world_body, rng)
        if dark_s[0] <= t_ns / S < dark_s[1]:
            seen = seen.take(np.zeros(0, int))
        tracked = ladder.locate(t_ns, seen)
        status.append(ladder.status)
        off_m.append(np.linalg.norm(tracked.T_world_body.t - T_world_body.t))
    return status, np.array(off_m), ladder


def turn(s):
    """To the side by a radian between 5.0 and 5.6 s, and back."""
    return 0.2 * np.sin(s) + np.exp(-(((s - 5.4) / 0.25) ** 2))


def test_with_an_imu_a_camera_is_followed_through_a_turn_in_the_dark_that_loses_it_without():
    dark_s = (5.05, 5.75)
    with_imu, off_m, ladder = followed(True, dark_s, turn)
    without, _, _ = followed(False, dark_s, turn)
    assert without.count("lost") >= 6
    assert "lost" not in with_imu
    assert off_m.max() < 0.1
    assert with_imu.count("degraded") >= 6
    assert with_imu[-1] == "tracking"
    assert ladder.temporary_left == 0


def test_where_an_imu_knows_too_little_the_camera_is_lost_all_the_same():
    status, off_m, _ = followed(True, (0.75, 4.0), turn)  # dark before biases and gravity are known
    assert 10 < status.count("lost") < 33
    assert off_m[np.array(status) != "lost"].max() < 0.2
    assert status[-1] == "tracking"


def test_nothing_changes_for_a_camera_that_is_well_followed():
    plain, off_plain, _ = followed(False, (9.0, 9.0), turn)
    inertial, off_inertial, _ = followed(True, (9.0, 9.0), turn)
    assert plain == inertial
    assert abs(np.median(off_plain) - np.median(off_inertial)) < 0.001
