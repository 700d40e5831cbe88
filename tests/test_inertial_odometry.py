"""Odometry on simulated tracks and samples: it starts, stays close to the truth, says what it lacks, and goes on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lodelight.anchors import tag_corners
from lodelight.errors import SourceError
from lodelight.evaluation.compare import Comparison, compare
from lodelight.geometry.se3 import SE3
from lodelight.imu.initialization import upright
from lodelight.messages import Frame, Imu, TagSighting
from lodelight.odometry.inertial import InertialOdometry, OdometryStep
from lodelight.rig import ImuSpec
from lodelight.sim.motion import Motion
from lodelight.trajectory import Trajectory
from odometry_scenes import START_NS, Points, flight, messages, rig


def run(
    motion: Motion, cameras: int, seed: int = 0, change=None, sigma_px: float = 0.06, spec: ImuSpec | None = None,
    look=lambda frame: (),
) -> tuple[list[OdometryStep], InertialOdometry, list]:  # fmt: skip
    """change : called with every message; returns what is fed instead, None = nothing; look : tags of a frame"""
    world, events = rig(cameras, spec), []
    odometry = InertialOdometry(
        world, "stereo" if cameras > 1 else "mono", on_event=lambda t, kind, **f: events.append((t, kind, f))
    )
    odometry.tracker = Points(motion, world, seed, sigma_px)
    steps = []
    for message in messages(motion, world.imu, seed):
        message = change(message) if change else message
        if message is None:
            continue
        tags = look(message) if isinstance(message, Frame) else ()
        step = odometry.feed_frame(message, tags) if isinstance(message, Frame) else odometry.feed_imu(message)
        if step is not None:
            steps.append(step)
    return steps, odometry, events


def judged(steps: list[OdometryStep], motion: Motion) -> Comparison:
    live = [s for s in steps if s.status in ("tracking", "degraded")]
    path = Trajectory.from_poses([s.frame.t_ns for s in live], [s.state.T_world_body for s in live])
    stamps = np.array([s.frame.t_ns for s in live])
    return compare(
        path, motion.trajectory(200.0), "yaw", 0.01, (stamps, np.stack([s.covariance[:6, :6] for s in live]))
    )


def seconds(step: OdometryStep) -> float:
    return (step.frame.t_ns - START_NS) * 1e-9


def test_one_camera_starts_in_flight_and_stays_within_centimetres():
    """Tracks that wander by 0.06 px a frame, EuRoC's IMU: 1 cm over 10 m of path; the bound is three times that."""
    motion = flight(6.0, seed=0)
    steps, odometry, events = run(motion, 1)
    started = next(s for s in steps if s.status == "tracking")
    assert seconds(started) <= 2.0
    assert [kind for _, kind, _ in events].count("start") == 1
    assert odometry.restarts == 0
    found = judged(steps, motion)
    assert found.ate.rmse_m < 0.03
    assert found.ate.rotation_deg < 1.0
    assert found.nees is not None
    assert found.nees.pose < 6 * 1.5
    before = steps[: steps.index(started)]
    assert all(s.status == "initializing" and s.why for s in before)
    assert "needed" in before[3].why


def test_an_imu_that_is_said_to_have_no_noise_is_believed_only_almost():
    spec = ImuSpec(gyro_noise=0.0, gyro_walk=0.0, accel_noise=0.0, accel_walk=0.0)
    steps, odometry, _ = run(flight(2.5, seed=0), 2, spec=spec)
    assert odometry.restarts == 0
    assert steps[-1].status == "tracking"
    assert judged(steps, flight(2.5, seed=0)).ate.rmse_m < 0.03
    assert np.isfinite(steps[-1].covariance).all()


def test_standing_still_starts_within_half_a_second():
    motion = flight(2.0, seed=1, rest_s=1.0)
    steps, _, events = run(motion, 1, sigma_px=0.03)
    started = next(s for s in steps if s.status == "tracking")
    assert seconds(started) <= 0.5
    assert next(f["how"] for _, kind, f in events if kind == "start") == "at rest"
    assert np.linalg.norm(started.state.v_world) < 0.02
    up = started.state.T_world_body.R.T @ [0.0, 0.0, 1.0]
    true_up = motion.at_ns(np.array([started.frame.t_ns])).R_world_body[0].T @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(up @ true_up)) < 1.5  # an accelerometer bias of 0.1 m/s^2 tilts by 0.6 deg


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda m: dataclasses.replace(m, accel=m.accel / 9.80665), "in g"),
        (lambda m: dataclasses.replace(m, gyro=np.degrees(m.gyro)), "deg/s"),
        (lambda m: dataclasses.replace(m, accel=-m.accel), "sign is turned"),
    ],
)
def test_an_imu_of_another_unit_or_sign_is_named(change, named):
    motion = flight(2.5, seed=2)
    with pytest.raises(SourceError, match=named):
        run(motion, 1, change=lambda m: change(m) if isinstance(m, Imu) else m)


def test_a_turned_accelerometer_is_named_after_a_start_at_rest_once_one_camera_moves():
    motion = flight(4.5, seed=2, rest_s=1.0)
    with pytest.raises(SourceError, match="sign is turned"):
        run(motion, 1, change=lambda m: dataclasses.replace(m, accel=-m.accel) if isinstance(m, Imu) else m)


def test_a_push_before_the_start_is_not_taken_for_a_bias():
    """1 m/s^2 that is no motion over the first 0.6 s, as of a drone that leaves the ground: later images are used."""
    motion = flight(3.0, seed=0)
    push = np.array([0.0, 1.0, 0.0])

    def change(m):
        pushed = isinstance(m, Imu) and m.t_ns < START_NS + 600_000_000
        return dataclasses.replace(m, accel=m.accel + push) if pushed else m

    steps, odometry, _ = run(motion, 1, change=change)
    started = next(s for s in steps if s.status == "tracking")
    assert any("are likely" in s.why for s in steps[: steps.index(started)])
    assert seconds(started) <= 2.3
    assert odometry.restarts == 0
    true = motion.at_ns(np.array([started.frame.t_ns]))
    v_body = started.state.T_world_body.R.T @ started.state.v_world
    assert np.linalg.norm(v_body - true.R_world_body[0].T @ true.v_world[0]) < 0.1


def test_without_imu_it_says_so_and_after_a_hole_it_starts_again_where_it_was():
    motion = flight(5.0, seed=3)
    hole = (START_NS + 2_000_000_000, START_NS + 2_800_000_000)
    steps, odometry, events = run(
        motion, 1, change=lambda m: None if isinstance(m, Imu) and hole[0] < m.t_ns < hole[1] else m
    )
    assert odometry.restarts == 1
    assert [k for _, k, _ in events].count("failure") == 1
    lost = [s for s in steps if s.status == "lost"]
    assert lost
    assert "IMU" in lost[0].why
    again = next(s for s in steps if s.restarted and s.frame.t_ns > hole[1])
    assert seconds(again) < 4.8


def test_stamps_of_another_clock_are_told_in_every_frame():
    motion = flight(1.0, seed=4)
    steps, odometry, _ = run(
        motion, 1, change=lambda m: dataclasses.replace(m, t_ns=m.t_ns + 10**13) if isinstance(m, Imu) else m
    )
    last = odometry.flush()
    steps = [*steps, last] if last else steps
    assert steps
    assert all(s.status == "initializing" for s in steps)
    assert "another clock" in steps[-1].why


def test_the_upright_frame_has_gravity_down():
    rng = np.random.default_rng(0)
    for down in rng.standard_normal((20, 3)):
        R = upright(down)
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) > 0
        assert np.allclose(R @ down, [0.0, 0.0, -np.linalg.norm(down)])


WALL_TAG = SE3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([2.6, 0.1, 1.5]))
SIZE_M, SIGMA_TAG_PX = 0.3, 0.3


def with_tag(steps_motion: Motion, moved_at_s: float = np.inf):
    """Sightings of one tag on the wall ahead, that hangs half a metre aside from a moment on."""
    rng, camera = np.random.default_rng(5), rig(1).cameras[0]

    def look(frame: Frame) -> list[TagSighting]:
        T = steps_motion.at_ns(np.array([frame.t_ns])).poses()[0] @ camera.T_body_cam
        aside = np.array([0.0, 0.5 * ((frame.t_ns - START_NS) * 1e-9 > moved_at_s), 0.0])
        px, seen = camera.camera.project(T.inverse() @ (WALL_TAG @ tag_corners(SIZE_M) + aside))
        if not seen.all():
            return []
        px = px + SIGMA_TAG_PX * rng.standard_normal((4, 2))
        return [TagSighting(frame.t_ns, "tag36h11", "3", px, np.full(4, SIGMA_TAG_PX), size_m=SIZE_M)]

    return look


def length_ratio(steps: list[OdometryStep], motion: Motion) -> float:
    live = [s for s in steps if s.status == "tracking"]
    ours = np.array([s.state.T_world_body.t for s in live])[::10]
    true = motion.at_ns(np.array([s.frame.t_ns for s in live])).xyz[::10]
    lengths = [np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum() for xyz in (ours, true)]
    return float(lengths[0] / lengths[1])


def test_one_camera_starts_in_flight_within_the_first_frames_that_show_a_tag_of_known_size():
    motion = flight(2.0, seed=1)
    steps, odometry, events = run(motion, 1, look=with_tag(motion))
    started = next(s for s in steps if s.status == "tracking")
    assert seconds(started) <= 0.25
    assert next(f["how"] for _, kind, f in events if kind == "start") == "in motion"
    true = motion.at_ns(np.array([started.frame.t_ns]))
    v_body = started.state.T_world_body.R.T @ started.state.v_world
    assert np.linalg.norm(v_body - true.R_world_body[0].T @ true.v_world[0]) < 0.05
    up = started.state.T_world_body.R.T @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(up @ true.R_world_body[0].T @ [0.0, 0.0, 1.0])) < 2.0
    assert odometry.restarts == 0
    assert abs(length_ratio(steps, motion) - 1.0) < 0.01


def test_a_tag_keeps_the_scale_where_the_imu_is_ten_times_as_noisy():
    motion = flight(4.0, seed=6)
    spec = ImuSpec(gyro_noise=1.7e-3, accel_noise=2e-2)
    steps, odometry, _ = run(motion, 1, spec=spec, look=with_tag(motion))
    assert odometry.window is not None
    assert odometry.window.knows("tag36h11 3")
    assert abs(length_ratio(steps, motion) - 1.0) < 0.01


@pytest.mark.parametrize(("cameras", "says", "within_s"), [(1, 1.5, 2.5), (2, 0.8, 0.5)])
def test_a_tag_of_another_size_than_it_says_is_named_by_how_much(cameras, says, within_s):
    motion = flight(2.5, seed=0)
    shown = with_tag(motion)
    steps, _, events = run(
        motion, cameras, look=lambda f: [dataclasses.replace(s, size_m=says * SIZE_M) for s in shown(f)]
    )
    t_ns, fields = next((t, f) for t, kind, f in events if kind == "tag" and "measures" in f["why"])
    assert (t_ns - START_NS) * 1e-9 <= within_s
    measured = float(fields["why"].split("measures ")[1].split(" m")[0])
    assert abs(measured / SIZE_M - 1.0) < 0.06
    assert abs(length_ratio(steps, motion) - 1.0) < 0.05


def test_a_tag_that_is_moved_is_named_within_three_frames_and_has_no_say():
    motion = flight(5.0, seed=6)
    steps, odometry, events = run(motion, 1, look=with_tag(motion, moved_at_s=3.5))
    named = [(t, f) for t, kind, f in events if kind == "tag"]
    assert [f["tag"] for _, f in named] == ["tag36h11 3"]
    first = next(s.frame.t_ns for s in steps if (s.frame.t_ns - START_NS) * 1e-9 > 3.5 and s.tags)
    assert named[0][0] - first <= 2 * 50_000_000
    assert odometry.restarts == 0
    assert judged(steps, motion).ate.rmse_m < 0.03
