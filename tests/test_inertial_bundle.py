"""A flight of keyframes, points and IMU adjusted as a whole: the slope of its cost, its scale, its vertical."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from inertial_scenes import look, project, samples_near, scene, state_error
from lodelight.estimation.bundle_problem import BundleProblem
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.estimation.inertial_bundle import (
    ImuChain,
    InertialAdjustment,
    inertial_bundle_adjust,
    lengths,
    standing,
    tied,
)
from lodelight.estimation.window_frames import prepared
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.imu.preintegration import NavState, preintegrate
from lodelight.mapping.inertial_adjust import weighed

STRETCH, TILT = 1.05, 0.03  # what the start is off by: a monocular scale, and radians about x


def flight(seed: int, duration_s: float) -> tuple[BundleProblem, ImuChain, list[NavState]]:
    """Keyframes four times a second along a walk; the start is stretched, tilted, and without biases."""
    made = scene(seed, duration_s=duration_s, rate_hz=4.0, points=400, max_tracks=80)
    stamps = [int(t) for t in made.frame_ns]
    truth = [made.truth(t) for t in stamps]
    seen = [look(made, t)[0] for t in stamps]
    track = np.concatenate([s.track for s in seen])
    row = np.repeat(np.arange(len(seen)), [len(s.track) for s in seen])
    px = np.concatenate([s.px for s in seen])
    points = made_points(made, stamps, seen)
    point = {t: p for s, at in zip(seen, points, strict=True) for t, p in zip(s.track.tolist(), at, strict=True)}
    ids, which, count = np.unique(track, return_inverse=True, return_counts=True)
    kept = count[which] >= 2
    ids, which = np.unique(track[kept], return_inverse=True)
    n = int(kept.sum())
    origin, R0 = truth[0].T_world_body.t, so3_exp(np.array([TILT, 0.0, 0.0]))
    moved = [
        SE3(R0 @ t.T_world_body.R, origin + STRETCH * R0 @ (t.T_world_body.t - origin)) for t in truth
    ]  # fmt: skip
    xyz = np.array([origin + STRETCH * R0 @ (point[int(i)] - origin) for i in ids])
    R = truth[0].T_world_body.R
    information = np.diag([1.0, 1.0, 1e8, 1e8, 1e8, 1e8])
    information[:3, :3] = R.T @ information[:3, :3] @ R
    problem = BundleProblem(
        made.rig.cameras[0].camera, made.rig.cameras[0].T_body_cam, np.stack([T.R for T in moved]),
        np.stack([T.t for T in moved]), np.zeros(len(moved), bool), xyz, row[kept].astype(np.int32),
        which.astype(np.int32), px[kept], np.full(n, made.sigma_px), np.zeros(n), np.ones(n),
        priors=[PosePrior(0, truth[0].T_world_body, information)],
    )  # fmt: skip
    spec = made.rig.imu
    assert spec is not None
    none = np.zeros(3)
    links = [
        prepared(preintegrate(samples_near(made.samples, a, b).between(a, b), none, none, spec))
        for a, b in itertools.pairwise(stamps)
    ]
    k = len(moved)
    velocity = np.gradient(problem.p, 0.25, axis=0)
    chain = ImuChain(
        np.arange(k - 1, dtype=np.int32), np.arange(1, k, dtype=np.int32), np.stack([m for m, _ in links]),
        np.stack([w for _, w in links]), np.zeros(1, np.int32), np.hstack([velocity, np.zeros((k, 6))]),
    )  # fmt: skip
    return problem, chain, truth


def made_points(made, stamps, seen):
    """Of every sighting the true point, found as the one that lies under its pixel."""
    for t, s in zip(stamps, seen, strict=True):
        px, ahead = project(made, made.truth(t).T_world_body, 0, made.points)
        visible = np.flatnonzero(ahead)
        away = np.linalg.norm(px[visible][None] - s.px[:, None], axis=2)
        yield made.points[visible[away.argmin(axis=1)]]


@pytest.fixture(scope="module")
def walk() -> tuple[BundleProblem, ImuChain, list[NavState]]:
    return flight(5, 8.0)


def test_the_slope_is_that_of_the_cost(walk):
    problem, chain, _ = walk
    chain = lengths(
        replace(chain, still=np.array([7], np.int32)), problem.R, 1.02 * problem.p, np.full(len(problem.p), 1e-4)
    )
    a = InertialAdjustment(problem, [], chain)
    a._linearize(a.state, a.linear, False, a.linear.chi2)
    g_pose, g_rest = a.linear.g_pose.copy(), a.linear.chain_g.copy()
    for k in (0, 7):
        for i in range(15):
            cost = []
            for h in (1e-6, -1e-6):
                s = a.trial
                s.R[:], s.p[:], s.xyz[:], s.rest[:] = a.state.R, a.state.p, a.state.xyz, a.state.rest
                if i < 3:
                    s.R[k] = s.R[k] @ so3_exp(h * np.eye(3)[i])
                elif i < 6:
                    s.p[k, i - 3] += h
                else:
                    s.rest[k, i - 6] += h
                a._linearize(s, a.trial_linear, False, a.linear.chi2)
                cost.append(a.trial_linear.cost)
            slope = g_pose[k, i] if i < 6 else g_rest[k, i - 6]
            assert slope == pytest.approx((cost[0] - cost[1]) / 4e-6, rel=1e-3, abs=20.0)


def test_one_camera_and_an_imu_find_scale_vertical_and_biases(walk):
    problem, chain, truth = walk
    result, rest = inertial_bundle_adjust(problem, chain, 30)
    states = [
        NavState(t.t_ns, SE3(R, p), r[:3], r[3:6], r[6:])
        for t, R, p, r in zip(truth, result.R, result.p, rest, strict=True)
    ]
    errors = np.array([state_error(s, t) for s, t in zip(states, truth, strict=True)])
    path = np.linalg.norm(np.diff(result.p, axis=0), axis=1).sum()
    true = np.linalg.norm(np.diff([t.T_world_body.t for t in truth], axis=0), axis=1).sum()
    assert path / true == pytest.approx(1.0, abs=0.01)
    assert np.degrees(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.5
    assert np.sqrt((errors[:, 3:6] ** 2).sum(axis=1).mean()) < 0.05
    assert np.abs(errors[:, 9:12]).max() < 2e-3  # of biases of 0.02 rad/s
    assert result.inliers.mean() > 0.93  # the test for outliers takes one in twenty


def test_a_pose_that_is_held_stays_and_others_follow_the_imu(walk):
    """Without a single sighting the IMU alone carries the chain from a held pose of known velocity."""
    problem, chain, truth = walk
    k = 5
    blind = replace(
        problem, R=np.stack([t.T_world_body.R for t in truth[:k]]), p=np.stack([t.T_world_body.t for t in truth[:k]]),
        fixed=np.arange(k) == 0, keyframe=problem.keyframe[:0], point=problem.point[:0], px=problem.px[:0],
        sigma_px=problem.sigma_px[:0], inv_depth=problem.inv_depth[:0], sigma_inv_depth=problem.sigma_inv_depth[:0],
        xyz=problem.xyz[:0], priors=[PosePrior(4, truth[4].T_world_body, 1e6 * np.eye(6))],
    )  # fmt: skip
    some = replace(chain, before=chain.before[: k - 1], after=chain.after[: k - 1], rest=chain.rest[:k])
    result, _ = inertial_bundle_adjust(blind, some)
    assert np.array_equal(result.p[0], truth[0].T_world_body.t)
    assert np.linalg.norm(result.p[2] - truth[2].T_world_body.t) < 0.1


def test_corners_that_fit_better_than_assumed_count_more(walk):
    problem, chain, _ = walk
    cautious = replace(problem, sigma_px=2.0 * problem.sigma_px)
    result, rest = inertial_bundle_adjust(cautious, chain, 20)
    again = weighed(cautious, result)
    assert np.median(again.sigma_px / problem.sigma_px) == pytest.approx(1.0, abs=0.1)
    result, _ = inertial_bundle_adjust(again, replace(chain, rest=rest), 5)
    assert np.median(weighed(again, result).sigma_px / again.sigma_px) == pytest.approx(1.0, abs=0.15)


def test_lengths_that_are_known_well_decide_over_the_scale(walk):
    problem, chain, truth = walk
    scale = []
    for sigma_m in (1e-3, 10.0):
        known = lengths(chain, problem.R, problem.p, np.full(len(problem.p), sigma_m**2))  # stretched, as the start is
        result, _ = inertial_bundle_adjust(problem, known, 30)
        steps = (
            np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in (result.p, [t.T_world_body.t for t in truth])
        )
        scale.append(next(steps) / next(steps))
    assert scale[0] == pytest.approx(STRETCH, abs=0.01)
    assert scale[1] == pytest.approx(1.0, abs=0.01)


def test_who_stands_or_sees_no_points_stays_beside_the_next(walk):
    """Four seconds before the first that sees, by an IMU alone: it would be anywhere within decimetres."""
    problem, chain, truth = walk
    k, imu = 17, chain.whiten.copy()
    imu[:, :9] *= 0.01  # of an IMU that knows next to nothing
    unseen = np.arange(len(problem.R)) < k
    seen = ~unseen[problem.keyframe]
    p = np.stack([t.T_world_body.t for t in truth])
    blind = replace(
        problem, R=np.stack([t.T_world_body.R for t in truth]), p=p, keyframe=problem.keyframe[seen],
        point=problem.point[seen], px=problem.px[seen], sigma_px=problem.sigma_px[seen],
        inv_depth=problem.inv_depth[seen], sigma_inv_depth=problem.sigma_inv_depth[seen],
    )  # fmt: skip
    poor = replace(chain, whiten=imu)
    result, _ = inertial_bundle_adjust(blind, tied(poor, unseen, blind.R, p, np.full(len(p), 1e-6)))
    way = np.einsum("kji,kj->ki", result.R[: k - 1], np.diff(result.p[:k], axis=0))
    true = np.einsum("kji,kj->ki", blind.R[: k - 1], np.diff(p[:k], axis=0))
    assert np.abs(way - true).max() < 5e-3
    measured, whiten = standing()
    links = replace(
        poor, before=np.append(poor.before, 0).astype(np.int32), after=np.append(poor.after, 1).astype(np.int32),
        measured=np.concatenate([poor.measured, measured[None]]), whiten=np.concatenate([poor.whiten, whiten[None]]),
        still=np.array([0, 1], np.int32),
    )  # fmt: skip
    result, rest = inertial_bundle_adjust(blind, links)
    assert np.linalg.norm(result.p[1] - result.p[0]) < 2e-3
    assert np.abs(rest[:2, :3]).max() < 0.05
