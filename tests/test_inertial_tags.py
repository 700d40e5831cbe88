"""Surveyed tags and the inertial window: held in the world, wrong ones kept out, the prior carried along."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from lodelight.estimation.marginalization import Key, Prior
from lodelight.estimation.window import Window
from lodelight.estimation.window_frames import moved_row
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp, so3_log
from lodelight.messages import Frame
from lodelight.odometry.probation import Probation
from lodelight.odometry.tag_views import tag_views
from tag_flights import WRONG, TaggedWalk, trials

YAWED = SE3.exp(np.array([0.0, 0.0, 0.7, 3.0, -1.0, 0.2]))


def test_a_walk_is_tied_to_the_world_by_tags_that_no_single_view_settles():
    """A level camera before upright tags: gravity does not tell which way they are turned, three views do."""
    walk = TaggedWalk(0, 15.2)
    odometry = walk.odometry()
    odometry.tie(walk.known())
    steps = [step for step in walk.steps(odometry) if step.status == "tracking"]
    free = [step for step in steps if not odometry._surveyed.tied]
    assert not free  # at the end it lies among them
    first = next(i for i, step in enumerate(steps) if step.tied)
    before, after = steps[first - 1], steps[first]
    assert np.linalg.norm(walk.error(before)[3:]) > 1.0  # its own origin
    assert np.linalg.norm(walk.error(after)[3:]) < 0.15
    tied = steps[first:]
    d = np.array([walk.error(step) for step in tied])
    P = np.array([step.covariance[:6, :6] for step in tied])
    # 1.35 deg are known of yaw by one tag whose corners are surveyed to 5 mm, and nothing is added without a tag
    yaw_deg = np.degrees(np.sqrt([step.covariance[2, 2] for step in tied]))
    alone = yaw_deg[3 : next(i for i, y in enumerate(yaw_deg) if y < 0.3)]
    assert len(alone) > 30
    assert alone[-30:].min() > 1.2
    nees = np.einsum("ni,ni->n", d, np.linalg.solve(P, d[:, :, None])[:, :, 0]) / 6
    assert nees.mean() < 1.5
    assert np.linalg.norm(d[-5:, 3:], axis=1).max() < 0.02  # two tags, 12 m apart
    assert np.degrees(np.linalg.norm(d[-5:, :3], axis=1).max()) < 0.2


def test_a_tag_has_no_say_before_its_views_have_shown_that_it_hangs_right():
    """`python benchmarks/wrong_tags.py` has a thousand. A turned one is named as soon as noise does not explain it."""
    done = list(trials(TaggedWalk(3, 12.0, count=48), ("right", *WRONG), 25, np.random.default_rng(0)))
    kinds = Counter(trial.kind for trial in done)
    assert len(kinds) == 5
    right = [trial for trial in done if trial.kind == "right"]
    assert [trial for trial in right if trial.used != 3 or trial.named] == []
    wrong = [trial for trial in done if trial.kind != "right"]
    assert [trial for trial in wrong if trial.used or trial.lost] == []
    assert [trial for trial in wrong if trial.kind != "flipped" and not 1 <= trial.named <= 3] == []


@pytest.mark.parametrize("moved", [False, True])
def test_a_window_begun_anew_goes_on_in_its_world_and_a_moved_tag_does_not_lay_it_elsewhere(moved):
    """1.6 s in the dark at 1 m/s: the IMU goes on. Then one tag is seen, which hangs 0.4 m aside or not."""
    walk = TaggedWalk(1, 8.0, count=48)
    odometry = walk.odometry()
    odometry.tie(walk.known())
    dark = (walk.motion.start_ns + 3_000_000_000, walk.motion.start_ns + 4_600_000_000)
    shown: list[str] = []
    done = []
    for message in walk.messages():
        if isinstance(message, Frame):
            unlit = dark[0] < message.t_ns < dark[1]
            odometry.tracker.wanted = 0 if unlit else 150
            seen = [] if unlit else walk.look(message)
            if unlit:
                odometry.tracker.reset()
            elif message.t_ns > dark[1] and seen:
                if not shown:
                    shown.append(seen[0].id)
                    T = walk.hung[seen[0].id]
                    walk.hung[seen[0].id] = SE3(T.R, T.t + moved * np.array([0.4, 0.0, 0.0]))
                seen = [s for s in walk.look(message) if s.id in shown]
            step = odometry.feed_frame(message, seen)
        else:
            step = odometry.feed_imu(message)
        if step is not None:
            done.append((step, odometry._surveyed.tied))
    anew = max(i for i, (step, _) in enumerate(done) if step.restarted)
    assert odometry.restarts == 1
    assert done[anew - 1][0].status == "lost"
    step, tied = done[anew]
    error, sigma = np.linalg.norm(walk.error(step)[3:]), np.sqrt(np.trace(step.covariance[3:6, 3:6]))
    assert not tied
    assert error < 0.1
    assert error < 3.0 * sigma
    assert any(tied for _, tied in done[anew:]) is not moved
    assert max(np.linalg.norm(walk.error(step)[3:]) for step, _ in done[anew:]) < 0.15


def test_both_copies_of_a_tag_seen_twice_in_one_image_are_left_out():
    walk = TaggedWalk(0, 1.0)
    window = Window(walk.rig)
    t_ns = int(next(iter(walk.messages())).t_ns)
    T_world_cam = walk.truth(t_ns) @ walk.rig.cameras[0].T_body_cam
    s = walk.sight(t_ns, "1", T_world_cam @ SE3(np.eye(3), np.array([0.0, 0.1, 1.5])))
    assert s is not None
    for shown, count in (([s], 1), ([s, replace(s, corners_px=s.corners_px + 60.0)], 0)):
        views, _ = tag_views(
            window,
            shown,
            T_world_cam,
            lambda name: None,
            lambda s, T: T @ SE3.identity(),
            Probation(walk.rig.cameras[0]),
        )
        assert len(views) == count


# -- the prior --------------------------------------------------------------------------------------------------------


def states(rng: np.random.Generator) -> dict[Key, np.ndarray]:
    def row(n: int) -> np.ndarray:
        return np.concatenate([so3_exp(rng.normal(0, 1, 3)).ravel(), rng.normal(0, 8, 3), rng.normal(0, 1, n - 12)])

    return {("pose", 0): row(21), ("pose", 1): row(21), ("tag", 0): row(12)}


def difference(x: dict[Key, np.ndarray], lin: dict[Key, np.ndarray], keys: list[Key]) -> np.ndarray:
    out = []
    for key in keys:
        a, b = x["pose", key[1]] if key[0] == "rest" else x[key], lin["pose", key[1]] if key[0] == "rest" else lin[key]
        if key[0] == "rest":
            out.append(a[12:] - b[12:])
        else:
            turn = so3_log(np.ascontiguousarray(b[:9].reshape(3, 3).T @ a[:9].reshape(3, 3)))
            out.append(np.concatenate([turn, a[9:12] - b[9:12]]))
    return np.concatenate(out)


def cost(prior: Prior, x: dict[Key, np.ndarray], lin: dict[Key, np.ndarray]) -> float:
    d = difference(x, lin, prior.keys)
    return float(d @ prior.H @ d + 2.0 * prior.g @ d)


def test_a_prior_carried_along_measures_no_yaw_that_it_does_not_know():
    rng = np.random.default_rng(0)
    lin = states(rng)
    keys: list[Key] = [("pose", 0), ("rest", 0), ("pose", 1), ("rest", 1), ("tag", 0)]
    A = rng.normal(size=(80, 36)) * 100.0
    prior = Prior(keys, A.T @ A, np.zeros(36))
    N = prior.null_space(lin)
    P = np.eye(36) - N @ np.linalg.pinv(N)
    relative = Prior(keys, P @ prior.H @ P, np.zeros(36))
    turned = {key: moved_row(row, YAWED.R, YAWED.t) for key, row in lin.items()}
    assert cost(relative, turned, lin) > 1e4  # the square of 0.7 rad taken for a measurement
    carried = relative.carried(YAWED.R, turned, np.array([0.7, 0.0, 0.0, 0.0]))
    assert abs(cost(carried, turned, turned)) < 1e-6
    np.testing.assert_allclose(carried.H @ carried.null_space(turned), 0.0, atol=1e-6 * np.abs(carried.H).max())
    np.testing.assert_allclose(carried.g, 0.0, atol=1e-6 * np.abs(carried.H).max())


@pytest.mark.parametrize("yaw", [1e-3, 1e-2])
def test_what_is_known_of_yaw_and_position_stays_where_it_was(yaw):
    """Known to half a degree and 5 mm about the old place: so it is about the new one."""
    rng = np.random.default_rng(1)
    lin = states(rng)
    prior = Prior([("pose", 0)], np.diag([1e8, 1e8, 1e4, 4e4, 4e4, 4e4]), np.zeros(6))
    upright = np.concatenate([np.eye(3).ravel(), lin["pose", 0][9:]])
    lin = {("pose", 0): upright}
    R = so3_exp(np.array([0.0, 0.0, yaw]))
    t = np.array([0.02, -0.01, 0.0])
    moved = {("pose", 0): moved_row(upright, R, t)}
    shift = moved["pose", 0][9:12] - upright[9:12]
    x, y = moved["pose", 0][9:11]
    step = shift - yaw * np.array([-y, x, 0.0])
    carried = prior.carried(R, moved, np.array([yaw, *step]))
    best = -np.linalg.solve(carried.H, carried.g)
    assert best[2] == pytest.approx(-yaw, rel=1e-6)
    np.testing.assert_allclose(moved["pose", 0][9:12] + best[3:6], upright[9:12], atol=1e-9)
