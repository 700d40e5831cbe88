"""The sliding window on simulated features: consistency, observability, tags, faults, and GTSAM's batch solution."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from inertial_scenes import CORNERS, START, fly, look, nees, perturbed, samples_near, scene, state_error
from lodelight.errors import CalibrationError, ConfigError, SourceError
from lodelight.estimation.marginalization import Prior, schur
from lodelight.estimation.window import Observations, StartSigma, Tag, Window, WindowConfig
from lodelight.estimation.window_visual import SIGMA_INV_DEPTH
from lodelight.geometry.se3 import SE3


def run(made, config=None, frames=None, tags="none", start=START, keyframe_every=2):
    """A window fed with every frame; returns it with the last truth."""
    window = Window(made.rig, config or WindowConfig())
    for name, T in made.tags.items():
        if tags != "none":
            window.declare(Tag(name, CORNERS, T if tags == "known" else None))
    for i, t_ns in enumerate(made.frame_ns[:frames].tolist()):
        observations, views = look(made, t_ns)
        views = views if tags != "none" else []
        if i == 0:
            window.start(perturbed(made.truth(t_ns), start, made.rng), start, observations, views)
            continue
        samples = samples_near(made.samples, window.newest.t_ns, t_ns)
        window.add_frame(t_ns, samples, observations, views, keyframe=i % keyframe_every == 0)
        assert window.solve().ok
    return window


def test_marginalizing_at_once_or_in_turn_is_the_same_and_keeps_the_optimum():
    rng = np.random.default_rng(0)
    J, r = rng.normal(size=(60, 21)) * 10.0 ** rng.uniform(-3, 3, 21), rng.normal(size=60)
    H, g = J.T @ J, J.T @ r
    best = -np.linalg.solve(H, g)
    prior = Prior([("pose", 0), ("rest", 0), ("pose", 1)], H, g)
    rest = prior.without([("pose", 0)]).without([("rest", 0)])
    at_once = prior.without([("rest", 0), ("pose", 0)])
    np.testing.assert_allclose(-np.linalg.solve(rest.H, rest.g), best[15:], rtol=1e-6)
    np.testing.assert_allclose(rest.H, at_once.H, rtol=1e-8)
    np.testing.assert_allclose(np.linalg.inv(rest.H), np.linalg.inv(H)[15:, 15:], rtol=1e-6)


def test_what_is_not_measured_does_not_break_the_marginalization():
    H, g = schur(np.diag([0.0, 4.0, 1.0]), np.array([0.0, 2.0, 3.0]), np.array([True, True, False]))
    np.testing.assert_allclose(H, [[1.0]])
    np.testing.assert_allclose(g, [3.0])


def test_yaw_and_position_stay_unmeasured_after_a_hundred_marginalizations():
    """Nothing absolute is measured: once the start's gauge is released, the prior's null space is all of it."""
    made = scene(1, duration_s=21.5, rate_hz=10.0, max_tracks=60)
    window = run(made, WindowConfig(iterations=2), frames=5)
    window.align(SE3.identity(), release_gauge=True)
    assert not window.beliefs
    N = window.prior.null_space(window.lin_rows())
    P = np.eye(15) - N @ np.linalg.pinv(N)
    window.prior = replace(window.prior, H=P @ window.prior.H @ P)  # and nothing at all is left of it
    left = 0
    for i, t_ns in enumerate(made.frame_ns[5:].tolist()):
        observations, _ = look(made, t_ns)
        window.add_frame(t_ns, samples_near(made.samples, window.newest.t_ns, t_ns), observations, keyframe=i % 2 == 1)
        assert window.solve().ok
        left += len(window.departed())
    assert left >= 95
    prior = window.prior
    N = prior.null_space(window.lin_rows())
    N /= np.linalg.norm(N, axis=0)
    assert np.linalg.norm(prior.H @ N, axis=0).max() < 1e-6 * np.linalg.norm(prior.H)
    assert np.linalg.eigvalsh(prior.H)[4] > -1e-6 * np.linalg.norm(prior.H)


def test_a_surveyed_tag_measures_what_was_unmeasured():
    made = scene(1, duration_s=6.0, rate_hz=10.0, tags=10)
    window = run(made, tags="known")
    prior = window.prior
    N = prior.null_space(window.lin_rows())
    information = np.diag(N.T @ prior.H @ N)
    assert information.min() > 1e3  # 30 mm, 2 degrees, far more than the start's sigma would leave in a drifting window


@pytest.mark.parametrize(("cameras", "tags"), [(1, "none"), (2, "none"), (1, "known"), (1, "estimated")])
def test_errors_are_as_large_as_the_covariances_say(cameras, tags):
    """A few seeds: the mean of so few flights wanders by 0.3; `benchmarks/window.py` runs fifty."""
    values = []
    for seed in range(20, 24):
        made = scene(
            seed, duration_s=5.0, rate_hz=10.0, cameras=cameras, max_tracks=60, tags=10 if tags != "none" else 0
        )
        flight = fly(made, WindowConfig(keyframes=8), tags, covariance_every=5)
        values.append(nees(flight.errors, flight.covariances, slice(0, 6)).mean())
        assert np.linalg.norm(flight.errors[-1, 3:6]) < 0.35
    assert 0.4 < np.mean(values) < 1.8


def test_the_same_input_gives_the_same_bytes():
    ends = []
    for _ in range(2):
        window = run(scene(2, duration_s=2.5, rate_hz=10.0, tags=8), tags="estimated")
        ends.append(np.concatenate([window.frames[-1].x, window.covariance().ravel(), window.landmarks().xyz.ravel()]))
    assert ends[0].tobytes() == ends[1].tobytes()


def test_every_sighting_counts_once_and_departed_landmarks_are_where_they_are():
    made = scene(3, duration_s=6.0, rate_hz=10.0, cameras=2)
    window = run(made)
    departed = window.departed()
    assert window.departed() == []
    assert [d.t_ns for d in departed] == sorted(d.t_ns for d in departed)
    assert len(departed) == 29 - 10 + 1  # keyframes fed, less those that are in the window
    for d, after in pairwise(departed):
        assert d.imu.t_ns[0] == d.t_ns
        assert d.imu.t_ns[-1] == after.t_ns
    xyz = np.vstack([d.landmarks.xyz[d.landmarks.seen >= 6] for d in departed])
    assert len(xyz) > 50
    nearest = np.min(np.linalg.norm(xyz[:, None] - made.points[None], axis=2), axis=1)
    assert np.median(nearest) < 0.15


def test_a_wrong_tag_is_refused_and_leaves_no_trace():
    made = scene(4, duration_s=6.0, rate_hz=10.0, tags=10)
    right = run(replace_rng(made), tags="known")
    wrong = replace_rng(scene(4, duration_s=6.0, rate_hz=10.0, tags=10))
    moved = {name: T.perturbed(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])) for name, T in wrong.tags.items()}
    window = Window(wrong.rig, WindowConfig())
    for name, T in wrong.tags.items():
        window.declare(Tag(name, CORNERS, T))
    refused = accepted = 0
    seen_before = set()
    for i, t_ns in enumerate(wrong.frame_ns.tolist()):
        observations, views = look(wrong, t_ns)
        if i == 0:
            window.start(perturbed(wrong.truth(t_ns), START, wrong.rng), START, observations)
            continue
        fake = []
        if i > 20:  # a tag that hangs a metre from where it was surveyed
            body = wrong.truth(t_ns).T_world_body
            for view in views:
                T_cam = (body @ wrong.rig.cameras[0].T_body_cam).inverse()
                px, seen = wrong.rig.cameras[0].camera.project(T_cam @ (moved[view.id] @ CORNERS))
                if seen.all():
                    fake.append(replace(view, corners_px=px))
        window.add_frame(
            t_ns, samples_near(wrong.samples, window.newest.t_ns, t_ns), observations, fake, keyframe=i % 2 == 0
        )
        solution = window.solve()
        refused += len(solution.tag_rejected)
        accepted += len(fake) - len(solution.tag_rejected)
        seen_before |= set(solution.tag_rejected)
    assert refused > 10
    assert accepted == 0
    assert np.linalg.norm(state_error(window.newest, wrong.truth(window.newest.t_ns))[3:6]) < 0.3
    assert np.linalg.norm(state_error(right.newest, made.truth(right.newest.t_ns))[3:6]) < 0.03


def replace_rng(made):
    return replace(made, rng=np.random.default_rng(5), track_of={})


def test_wrong_matches_are_left_out():
    made = scene(5, duration_s=4.0, rate_hz=10.0)
    window = Window(made.rig)
    named = total = 0
    for i, t_ns in enumerate(made.frame_ns.tolist()):
        observations, _ = look(made, t_ns)
        wrong = made.rng.random(len(observations.track)) < 0.05
        observations.px[wrong] += made.rng.uniform(-40.0, 40.0, (int(wrong.sum()), 2))
        if i == 0:
            window.start(perturbed(made.truth(t_ns), START, made.rng), START, observations)
            continue
        window.add_frame(t_ns, samples_near(made.samples, window.newest.t_ns, t_ns), observations, keyframe=i % 2 == 0)
        solution = window.solve()
        if i > 20:
            named += np.isin(observations.track[wrong], solution.outliers).sum()
            total += wrong.sum()
    assert named > 0.7 * total
    assert np.linalg.norm(state_error(window.newest, made.truth(window.newest.t_ns))[3:6]) < 0.15


def test_aligning_moves_everything_rigidly_and_changes_no_measurement():
    made = scene(6, duration_s=4.0, rate_hz=10.0, tags=8)
    window = run(made, tags="estimated")
    before, cost = window.newest, window.solve().cost
    covariance, xyz = window.covariance(), window.landmarks().xyz
    T = SE3.exp(np.array([0.0, 0.0, 1.1, 3.0, -2.0, 0.5]))
    window.align(T, release_gauge=False)
    np.testing.assert_allclose(window.landmarks().xyz, T @ xyz, atol=1e-9)
    solution = window.solve()
    assert solution.cost == pytest.approx(cost, abs=0.1)
    np.testing.assert_allclose(window.newest.T_world_body.t, (T @ before.T_world_body).t, atol=1e-3)
    turned = np.eye(15)
    turned[3:6, 3:6] = turned[6:9, 6:9] = T.R
    expected = turned @ covariance @ turned.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        window.covariance() / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.02
    )
    window.align(SE3.identity(), release_gauge=True)
    assert np.sqrt(np.diag(window.covariance())[3:6]).min() > 1.0
    with pytest.raises(ValueError, match="vertical"):
        window.align(SE3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])))


def test_standing_still_holds_the_velocity_and_finds_the_gyro_bias():
    made = scene(7, duration_s=3.0, rate_hz=10.0, standstill_s=8.0, begin_s=1.0)
    window = Window(made.rig)
    start = StartSigma(tilt_rad=0.02, velocity_m_s=0.1, bias_gyro=0.02)
    for i, t_ns in enumerate(made.frame_ns.tolist()):
        observations, _ = look(made, t_ns)
        if i == 0:
            window.start(perturbed(made.truth(t_ns), start, made.rng), start, observations, standstill=True)
            continue
        samples = samples_near(made.samples, window.newest.t_ns, t_ns)
        window.add_frame(t_ns, samples, observations, standstill=True)
        assert window.solve().ok
    assert len(window.frames) == 2  # one keyframe and the tail
    error = state_error(window.newest, made.truth(window.newest.t_ns))
    assert np.linalg.norm(error[6:9]) < 0.02
    assert np.linalg.norm(error[9:12]) < 0.002


def test_a_wrong_mounting_and_a_clock_that_is_off_are_found():
    made = scene(8, gait="walk", duration_s=14.0, rate_hz=10.0, cameras=2, tags=10)
    spec = made.rig.cameras[0]
    off = np.radians([0.8, -0.6, 0.5])
    wrong = [
        replace(c, T_body_cam=c.T_body_cam.perturbed(np.concatenate([off, np.zeros(3)]))) for c in made.rig.cameras
    ]
    late = 8_000_000  # the images' stamps are 8 ms early
    window = Window(replace(made.rig, cameras=tuple(wrong)), WindowConfig(calibrate="both"))
    for name, T in made.tags.items():
        window.declare(Tag(name, CORNERS, T))
    for i, t_ns in enumerate(made.frame_ns.tolist()):
        observations, views = look(made, t_ns + late)
        if i == 0:
            window.start(perturbed(made.truth(t_ns), START, made.rng), START, observations, views)
            continue
        samples = samples_near(made.samples, window.newest.t_ns, t_ns)
        window.add_frame(t_ns, samples, observations, views, keyframe=i % 2 == 0)
        assert window.solve().ok
    left = SE3(window.extrinsics()[0].R.T @ spec.T_body_cam.R, np.zeros(3)).angle
    assert np.degrees(left) < 0.25
    assert window.time_offset_s == pytest.approx(0.008, abs=0.002)


def test_depth_gives_the_scale_at_once():
    made = scene(9, duration_s=2.0, rate_hz=10.0)
    window = Window(made.rig)
    start = StartSigma(tilt_rad=0.01, velocity_m_s=1.0, bias_gyro=0.003, bias_accel=0.1)
    for i, t_ns in enumerate(made.frame_ns.tolist()):
        observations, _ = look(made, t_ns)
        points = {number: point for point, number in made.track_of.items()}
        T_cam_world = (made.truth(t_ns).T_world_body @ made.rig.cameras[0].T_body_cam).inverse()
        z = (T_cam_world @ made.points[[points[t] for t in observations.track.tolist()]])[:, 2]
        rho = 1.0 / z + 0.005 * made.rng.standard_normal(len(z))
        seen = replace(observations, inv_depth=np.maximum(rho, 1e-3), sigma_inv_depth=np.full(len(z), 0.005))
        if i == 0:
            window.start(perturbed(made.truth(t_ns), start, made.rng), start, seen)
            assert len(window.landmarks().track) == 0
            continue
        window.add_frame(t_ns, samples_near(made.samples, window.newest.t_ns, t_ns), seen, keyframe=True)
        assert window.solve().ok
    assert np.linalg.norm(state_error(window.newest, made.truth(window.newest.t_ns))[6:9]) < 0.05


def test_frames_without_anything_to_see_are_carried_by_the_imu():
    made = scene(10, duration_s=2.0, rate_hz=10.0, cameras=2)
    window = run(made)
    t_ns = int(made.frame_ns[-1]) + 400_000_000
    before = window.covariance()
    window.add_frame(t_ns, made.samples, Observations.none())
    assert window.solve().ok
    assert np.linalg.norm(state_error(window.newest, made.truth(t_ns))[3:6]) < 0.1
    assert np.trace(window.covariance()[3:6, 3:6]) > np.trace(before[3:6, 3:6])


def test_what_cannot_be_used_is_refused_in_words():
    made = scene(11, duration_s=1.0, tags=4)
    with pytest.raises(CalibrationError, match="no IMU"):
        Window(replace(made.rig, imu=None))
    with pytest.raises(ValueError, match="calibrate"):
        WindowConfig(calibrate="everything")
    window = run(made, frames=3)
    with pytest.raises(SourceError, match="must cover"):
        window.add_frame(window.newest.t_ns + 10_000_000_000, made.samples, Observations.none())
    observations, views = look(made, int(made.frame_ns[3]))
    if views:
        with pytest.raises(ConfigError, match="declared"):
            window.add_frame(int(made.frame_ns[3]), made.samples, observations, views)


@pytest.mark.parametrize("tags", [0, 24])
def test_the_window_agrees_with_a_batch_solution_by_gtsam(tags):
    """The same keyframes, tracks and IMU as points in space, projection and IMU factors: 0.013 sigma apart; and tags,
    surveyed to 5 mm and 1 degree, as poses with a prior and their corners as functions of body and tag.

    What is believed of a point's depth is a sphere there and a ray here, of the same width.

    The noise is a third of what is assumed, so that no robust kernel has anything to do.
    """
    gtsam = pytest.importorskip("gtsam", reason="needs GTSAM 4.3: pip install lodelight[reference]")
    made = scene(12, gait="drone", duration_s=2.0, rate_hz=4.0, cameras=1, max_tracks=60, tags=tags)
    window = Window(made.rig, WindowConfig(keyframes=20, reject_px=50.0))
    tracks, sighted = {}, []
    survey = np.diag(np.square([0.02] * 3 + [0.005] * 3))
    for name, T in made.tags.items():
        window.declare(Tag(name, CORNERS, T, survey))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start_state = perturbed(made.truth(int(made.frame_ns[0])), START, made.rng)
    spec, fitted = made.rig.imu, made.rig.cameras[0]
    fx, fy, cx, cy, k1, k2, p1, p2 = fitted.camera.params[:8]
    lens = gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, k1, k2, p1, p2)
    mount = gtsam.Pose3(gtsam.Rot3(fitted.T_body_cam.R), fitted.T_body_cam.t)
    for i, t_ns in enumerate(made.frame_ns.tolist()):
        observations, views = look(made, t_ns)
        observations = replace(observations, sigma_px=3.0 * observations.sigma_px)
        views = [replace(view, sigma_px=3.0 * view.sigma_px) for view in views]
        sighted += [(i, view) for view in views]
        for track, px in zip(observations.track.tolist(), observations.px, strict=True):
            tracks.setdefault(track, []).append((i, px))
        if i == 0:
            window.start(start_state, START, observations, views)
            continue
        samples = samples_near(made.samples, window.newest.t_ns, t_ns)
        window.add_frame(t_ns, samples, observations, views, keyframe=True)
    for _ in range(3):
        assert window.solve(30).ok
    assert all(seen.use for frame in window.frames for seen in frame.tags)
    X, V, B, L = (lambda k, c=c: gtsam.symbol(c, k) for c in "xvbl")
    for i, state in enumerate(window.keyframes()):
        T = state.T_world_body
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(T.R), T.t))
        values.insert(V(i), state.v_world)
        values.insert(B(i), gtsam.imuBias.ConstantBias(state.bias_accel, state.bias_gyro))
    R0, s = start_state.T_world_body.R, START
    tilt = R0.T @ np.diag([s.tilt_rad**2, s.tilt_rad**2, s.yaw_rad**2]) @ R0
    pose_covariance = np.zeros((6, 6))
    pose_covariance[:3, :3], pose_covariance[3:, 3:] = tilt, np.eye(3) * s.position_m**2
    pose0 = gtsam.Pose3(gtsam.Rot3(R0), start_state.T_world_body.t)
    gaussian, isotropic = gtsam.noiseModel.Gaussian.Covariance, gtsam.noiseModel.Isotropic.Sigma
    graph.add(gtsam.PriorFactorPose3(X(0), pose0, gaussian(pose_covariance)))
    graph.add(gtsam.PriorFactorVector(V(0), start_state.v_world, isotropic(3, s.velocity_m_s)))
    bias0 = gtsam.imuBias.ConstantBias(start_state.bias_accel, start_state.bias_gyro)
    sigma_bias = np.repeat([s.bias_accel, s.bias_gyro], 3)
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias0, gtsam.noiseModel.Diagonal.Sigmas(sigma_bias)))
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setAccelerometerCovariance(np.eye(3) * spec.accel_noise**2)
    params.setGyroscopeCovariance(np.eye(3) * spec.gyro_noise**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    for i, (t0, t1) in enumerate(pairwise(made.frame_ns.tolist())):
        cut, b = made.samples.between(t0, t1), window.keyframes()[i]
        imu = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias(b.bias_accel, b.bias_gyro))
        for k, dt in enumerate(np.diff(cut.t_ns) * 1e-9):
            gyro = 0.5 * (cut.gyro[k] + cut.gyro[k + 1])
            half = SE3.exp(np.concatenate([0.5 * dt * (gyro - b.bias_gyro), np.zeros(3)])).R
            accel = 0.5 * (cut.accel[k] + cut.accel[k + 1]) - b.bias_accel
            imu.integrateMeasurement(half @ accel + b.bias_accel, gyro, dt)
        graph.add(gtsam.ImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(i), imu))
        walk = np.sqrt((t1 - t0) * 1e-9) * np.repeat([spec.accel_walk, spec.gyro_walk], 3)
        graph.add(
            gtsam.BetweenFactorConstantBias(
                B(i), B(i + 1), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(walk)
            )
        )
    marks, ours_anchor = window.landmarks(), window.keyframes()[0].T_world_body.t
    for track, xyz in zip(marks.track.tolist(), marks.xyz, strict=True):
        values.insert(L(track), xyz)
        # what the window knows of any point's depth keeps those without parallax in place here too
        away = np.linalg.norm(xyz - ours_anchor)
        graph.add(gtsam.PriorFactorPoint3(L(track), xyz, isotropic(3, SIGMA_INV_DEPTH * away**2)))
        for i, px in tracks[track]:
            graph.add(gtsam.GenericProjectionFactorCal3DS2(px, isotropic(2, 3.0), X(i), L(track), lens, mount))
    T_key = {name: gtsam.symbol("t", k) for k, name in enumerate(dict.fromkeys(view.id for _, view in sighted))}
    for name, key in T_key.items():
        T = gtsam.Pose3(gtsam.Rot3(made.tags[name].R), made.tags[name].t)
        values.insert(key, T)
        graph.add(gtsam.PriorFactorPose3(key, T, gaussian(survey)))  # the same on either axes: it is round
    for i, view in sighted:
        graph.add(corners_factor(gtsam, X(i), T_key[view.id], view, fitted))
    assert bool(sighted) is bool(tags)
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(100)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    deviation = np.sqrt(np.diag(window.covariance()))
    last = len(made.frame_ns) - 1
    pose = theirs.atPose3(X(last))
    ours = window.newest
    turn = SE3(ours.T_world_body.R.T @ pose.rotation().matrix(), np.zeros(3)).log()[:3]
    apart = np.concatenate([turn, pose.translation() - ours.T_world_body.t, theirs.atVector(V(last)) - ours.v_world])
    assert np.abs(apart / deviation[:9]).max() < 0.03
    marginals = gtsam.Marginals(graph, theirs)
    P = marginals.marginalCovariance(X(last))
    np.testing.assert_allclose(deviation[:3], np.sqrt(np.diag(P))[:3], rtol=2e-3)
    np.testing.assert_allclose(
        deviation[3:6], np.sqrt(np.diag(pose.rotation().matrix() @ P[3:, 3:] @ pose.rotation().matrix().T)), rtol=2e-3
    )


def corners_factor(gtsam, key_body, key_tag, view, spec):
    """Corners of a tag in an image, with central differences in GTSAM's chart."""

    def residual(body, tag):
        xyz = SE3(tag.rotation().matrix(), np.asarray(tag.translation())) @ CORNERS
        T_world_cam = SE3(body.rotation().matrix(), np.asarray(body.translation())) @ spec.T_body_cam
        return (spec.camera.project(T_world_cam.inverse() @ xyz)[0] - view.corners_px).ravel()

    def evaluate(this, values, jacobians):
        poses = [values.atPose3(key_body), values.atPose3(key_tag)]
        if jacobians is not None:
            for at in (0, 1):
                columns = []
                for d in 1e-6 * np.eye(6):
                    moved = [[p.retract(sign * d) if k == at else p for k, p in enumerate(poses)] for sign in (1, -1)]
                    columns.append((residual(*moved[0]) - residual(*moved[1])) / 2e-6)
                jacobians[at] = np.asfortranarray(np.column_stack(columns))
        return residual(*poses)

    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(view.sigma_px, 2))
    return gtsam.CustomFactor(noise, [key_body, key_tag], evaluate)
