"""The motion of a camera from frame to frame, against cameras that move as they are told."""

import numpy as np
import pytest

from lodelight.geometry.se3 import SE3
from lodelight.localization.motion import Motion

DT_S = 1 / 30
TWIST = np.array([0.4, -0.9, 0.2, 0.5, -0.3, 0.1])  # rad/s and m/s in the body's frame


def followed(rng, twists, sigma):
    """The motion after poses that are known to sigma (rad, m), and the mean twist between the last two of them."""
    covariance = np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3)
    motion, T_true, last = Motion(), SE3.exp(np.array([0.3, 0.2, 2.0, 1.0, 2.0, 3.0])), None
    for twist in twists:
        T_true = T_true @ SE3.exp(DT_S * twist)
        now = T_true.perturbed(rng.normal(0.0, np.repeat(sigma, 3)))
        if last is not None:
            motion = motion.later(DT_S).measured(last, covariance, now, covariance, DT_S)
            pair = (last.inverse() @ now).log() / DT_S
        last = now
    return motion, pair


def test_where_poses_are_exact_to_millimetres_the_last_two_decide():
    before, after = TWIST, TWIST + np.array([0.3, 0.3, -0.3, 0.1, 0.1, -0.1])
    motion, _ = followed(np.random.default_rng(0), [before] * 10 + [after] * 2, (1e-4, 1e-4))
    np.testing.assert_allclose(motion.twist, after, atol=0.1)


def test_where_poses_are_exact_to_centimetres_many_are_weighed():
    off, off_pair = [], []
    for seed in range(40):
        motion, pair = followed(np.random.default_rng(seed), [TWIST] * 30, (5e-3, 2e-2))
        off.append(motion.twist - TWIST)
        off_pair.append(pair - TWIST)
    rms, rms_pair = (np.sqrt(np.mean(np.square(e), axis=0)) for e in (off, off_pair))
    assert np.all(rms[3:] < 0.3 * rms_pair[3:])
    # it allows for motions that change, and this one does not: it may be better than it says, and is not worse
    assert np.all(rms < 1.2 * np.sqrt(np.diag(motion.covariance)))


def test_what_is_known_of_a_motion_is_forgotten_in_a_while():
    motion = Motion(TWIST, 1e-4 * np.eye(6)).later(60.0)
    np.testing.assert_allclose(motion.twist, 0.0, atol=1e-3)
    np.testing.assert_allclose(motion.covariance, np.eye(6), atol=1e-3)


def test_a_camera_on_the_body_moves_as_the_body_does():
    T_body_cam = SE3.exp(np.array([0.2, -1.4, 0.3, 0.3, -0.2, 0.1]))
    dt_s = 1e-6
    cam = T_body_cam.inverse() @ Motion(TWIST).over(dt_s) @ T_body_cam
    camera = Motion(TWIST, np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])).of_camera(T_body_cam)
    np.testing.assert_allclose(camera.twist, cam.log() / dt_s, atol=1e-5)
    assert np.trace(camera.covariance[:3, :3]) == pytest.approx(6.0)
