"""Points that decide a pose by themselves, against poses had with and without them."""

import numpy as np
import pytest

from corridors import ORB, OTHER, Corridor
from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.localization.follower import Follower, _right
from lodelight.localization.influence import MOST, leverage
from lodelight.localization.temporary import TemporaryConfig, TemporaryPoints
from lodelight.localization.tracker import TrackerConfig

CAMERA = OTHER.cameras[0].camera
T_BODY_CAM = OTHER.cameras[0].T_body_cam
TRUE = SE3.exp(np.array([0.1, -0.2, 0.3, 0.5, -0.4, 0.2]))


def scene(seed, n=60, near_m=0.4):
    """(n + 1) world points in a far wall, the last but close to the camera, and where they are seen to 0.7 px."""
    rng = np.random.default_rng(seed)
    xyz_cam = np.column_stack([rng.uniform(-1.5, 1.5, n), rng.uniform(-1.0, 1.0, n), rng.uniform(5.0, 5.5, n)])
    xyz_cam = np.vstack([xyz_cam, [0.1, 0.05, near_m]])
    px, _ = CAMERA.project(xyz_cam)
    return (TRUE @ T_BODY_CAM) @ xyz_cam, px + rng.normal(0.0, 0.7, px.shape)


def seen_at(px):
    n = len(px)
    ray, _ = CAMERA.unproject(px)
    blank = np.zeros(n, np.float32)
    return Features(px.astype(np.float32), np.zeros(n, np.int32), blank, np.zeros((n, 4), np.uint64), ray, blank, blank)


def leverages(xyz, px, weight=None):
    n = len(xyz)
    weight = np.ones(n) if weight is None else weight
    return leverage(TRUE, T_BODY_CAM, CAMERA, xyz, px, np.full(n, 0.7), np.zeros(n), np.ones(n), weight)


def test_leverage_is_the_share_of_its_own_prediction_that_a_point_makes():
    xyz, px = scene(0)
    held = leverages(xyz, px)
    assert np.all((held >= 0.0) & (held <= 1.0 + 1e-9))
    assert np.argmax(held) == len(xyz) - 1
    assert held[-1] > 0.9
    assert np.all(held[:-1] < MOST)
    # six numbers are had from all of them: shares of each point's own two rows, of which the larger is at least half
    far = leverages(xyz[:-1], px[:-1])
    assert 3.0 <= far.sum() <= 6.0 + 1e-6
    assert leverages(xyz, px, np.append(np.ones(60), 0.0))[-1] == pytest.approx(0.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_point_that_is_not_where_it_was_mapped_does_not_move_the_pose_however_close_it_is(seed):
    xyz, px = scene(seed)
    px[-1] += [60.0, 10.0]  # what it is taken for, by chance: 0.15 m to the side would explain it
    corridor = Corridor.built(0)
    overlay = TemporaryPoints(OTHER.cameras[0], ORB, TemporaryConfig(), 1.0)
    follower = Follower(OTHER, corridor.mapped(0), ORB, TrackerConfig(), overlay)
    start = TRUE.perturbed(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    solved, _ = follower._solve_without_leverage(start, seen_at(px), xyz, np.ones(len(xyz)), np.zeros(len(xyz)), None)
    off_m = np.linalg.norm(solved.T_world_body.t - TRUE.t)
    assert off_m < 3.5 * np.sqrt(np.trace(solved.covariance[3:, 3:]))
    assert not solved.inliers[-1]


@pytest.mark.parametrize("noise", [1.0, 1.5, 2.0])
def test_matches_that_agree_by_chance_are_not_counted(noise):
    rng = np.random.default_rng(round(10 * noise))
    window = 7.5

    def chi2(n_right, n_wrong):
        right = noise * rng.normal(size=(n_right, 2))
        at, angle = window * np.sqrt(rng.random(n_wrong)), rng.uniform(0.0, 2.0 * np.pi, n_wrong)
        wrong = at[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.sum(np.vstack([right, wrong]) ** 2, axis=1)

    def counted(n_right, n_wrong):
        some = chi2(n_right, n_wrong)
        return _right(some, some < 5.991 * 16.0, window)  # by the bound of four times the noise, as of a blurred frame

    by_chance = [counted(0, 120) for _ in range(50)]
    assert np.mean(by_chance) < 15
    assert max(by_chance) < 40
    found = [counted(90, 40) for _ in range(50)]
    assert 0.6 * 90 < np.mean(found) < 1.15 * 90
