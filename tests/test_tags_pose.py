"""Poses from corners: both solutions, their covariance, and which one is believed."""

import numpy as np
import pytest

from lodelight.anchors import tag_corners
from lodelight.geometry.se3 import SE3
from lodelight.messages import TagSighting
from lodelight.tags.pose import angle_between, by_gravity, by_prediction, clear, tag_poses
from tag_scenes import EUROC, FISHEYE


def seen(T_cam_tag, camera=EUROC, sigma_px=0.3, rng=None, size_m=0.2):
    px, inside = camera.project(T_cam_tag @ tag_corners(size_m))
    assert inside.all()
    noise = 0.0 if rng is None else sigma_px * rng.standard_normal((4, 2))
    return TagSighting(0, "tag36h11", "3", px + noise, np.full(4, sigma_px))


def views(rng, n, far=(0.8, 3.0), most=1.0):
    """Poses with the tag in the image and its face to the camera."""
    while n:
        z = rng.uniform(*far)
        T = SE3.exp(np.array([*rng.uniform(-most, most, 2), rng.uniform(-3, 3), *rng.uniform(-0.2, 0.2, 2) * z, z]))
        if T.R[:, 2] @ T.t / np.linalg.norm(T.t) > 0.4:
            n -= 1
            yield T


@pytest.mark.parametrize("camera", [EUROC, FISHEYE], ids=["radtan", "equidistant"])
def test_without_noise_the_pose_is_exact(camera):
    for T in views(np.random.default_rng(0), 30, (0.6, 1.5)):
        best = tag_poses(seen(T, camera), 0.2, camera)[0]
        assert np.abs((best.T_cam_tag.inverse() @ T).log()).max() < 1e-5
        assert best.chi2 < 1e-6


def test_the_true_pose_is_one_of_two_and_its_covariance_is_honest():
    rng = np.random.default_rng(1)
    nees = []
    for T in views(rng, 400, (0.7, 1.6)):
        poses = tag_poses(seen(T, rng=rng), 0.2, EUROC)
        best = min(poses, key=lambda p: angle_between(p.T_cam_tag, T))
        d = np.concatenate([(best.T_cam_tag.inverse() @ T).log()[:3], T.t - best.T_cam_tag.t])
        nees.append(d @ np.linalg.solve(best.covariance, d) / 6)
    assert 0.8 < np.mean(np.minimum(nees, 10.0)) < 1.3  # far and square views are bent: their errors have wider tails
    assert 0.7 < np.median(nees) < 1.1  # of chi-square with 6 degrees, over 6: 0.89


def test_what_one_view_settles_is_right_and_far_tags_are_not_settled():
    rng = np.random.default_rng(2)
    settled = wrong = ambiguous = 0
    for T in views(rng, 1500, (0.7, 4.0), 1.2):
        sighting = seen(T, rng=rng)
        poses = tag_poses(sighting, 0.2, EUROC)
        chosen = clear(poses, sighting)
        ambiguous += len(poses) == 2 and chosen is None
        if chosen is not None:
            settled += 1
            wrong += chosen is not by_prediction(poses, T)
    assert settled > 200
    assert ambiguous > 200
    assert wrong == 0


def test_gravity_settles_a_tag_on_a_wall():
    rng = np.random.default_rng(3)
    right = asked = 0
    for _ in range(300):
        turn, z = rng.uniform(-1.0, 1.0), rng.uniform(1.5, 4.0)
        up_cam = SE3.exp(np.array([rng.uniform(-0.3, 0.3), 0, rng.uniform(-0.1, 0.1), 0, 0, 0])).R @ [0.0, -1.0, 0.0]
        level = SE3.exp(np.array([0.0, turn, 0.0, 0.0, 0.0, z]))  # upright where the camera is
        tilt = SE3.exp(np.array([*np.cross([0.0, -1.0, 0.0], up_cam), 0, 0, 0])).R
        T = SE3(tilt @ level.R, level.t)
        poses = tag_poses(seen(T, rng=rng), 0.2, EUROC)
        chosen = by_gravity(poses, up_cam)
        if len(poses) == 2 and chosen is not None:
            asked += 1
            right += chosen is by_prediction(poses, T)
    assert asked > 30
    assert right >= 0.97 * asked  # where both nearly hang upright, noise can still decide


def test_a_flat_or_hidden_outline_has_no_pose():
    line = TagSighting(0, "qr", "A", np.array([[10.0, 10], [20, 10], [30, 10], [40, 10]]), np.full(4, 0.3))
    assert all(np.isfinite(p.chi2) for p in tag_poses(line, 0.2, EUROC))
    assert clear([], line) is None
