"""A rolling shutter, against cameras that move exactly and rows that are read when they are."""

import numpy as np
import pytest

from lodelight.features.features import Features
from lodelight.features.shutter import Shutter
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.rig import CameraSpec

ROW_TIME_S = 30e-6
LENSES = {
    "radtan": ((400.0, 402.0, 318.0, 241.0), (-0.2, 0.05, 1e-3, -5e-4)),
    "equidistant": ((280.0, 281.0, 322.0, 238.0), (0.01, -0.003, 0.001, -2e-4)),
}
TWIST = np.array([1.5, -2.0, 1.0, 0.4, -0.2, 0.3])  # rad/s, m/s: a hand that shakes


def shutter(model="radtan", row_time_s=ROW_TIME_S, stamped_row=0.0):
    camera = Camera.create(model, 640, 480, *LENSES[model])
    return Shutter(CameraSpec("cam0", camera, SE3.identity(), row_time_s=row_time_s, stamped_row=stamped_row))


def rolled(camera, xyz, twist, row_time_s=ROW_TIME_S, stamped_row=0.0):
    """(N, 2) px where a rolling shutter sees points (N, 3) of the camera's frame at the stamp.

    The pixel is seen when its own row is read: iterated point by point, with exact motions.
    """
    px, _ = camera.project(xyz)
    for _ in range(8):
        for i in range(len(xyz)):
            dt_s = (px[i, 1] - stamped_row) * row_time_s
            # the camera's pose after dt, in its frame at the stamp
            moved = SE3(SE3.exp(np.append(dt_s * twist[:3], np.zeros(3))).R, dt_s * twist[3:])
            px[i] = camera.project(moved.inverse() @ xyz[i : i + 1])[0][0]
    return px


def points(rng, n=120):
    return np.column_stack([rng.uniform(-0.75, 0.75, n), rng.uniform(-0.5, 0.5, n), np.ones(n)]) * rng.uniform(
        1, 4, (n, 1)
    )


def seen_as(camera, px, inv_depth):
    n = len(px)
    ray, _ = camera.unproject(px)
    return Features(
        px.astype(np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32), np.zeros((n, 4), np.uint64), ray,
        inv_depth.astype(np.float32), (0.02 * inv_depth).astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("stamped_row", [0.0, 480.0])
@pytest.mark.parametrize("model", sorted(LENSES))
def test_rows_read_early_or_late_are_put_where_the_stamped_one_would_have_seen_them(model, stamped_row):
    rolling, xyz = shutter(model, stamped_row=stamped_row), points(np.random.default_rng(0))
    late = rolled(rolling.camera, xyz, TWIST, stamped_row=stamped_row)
    expected, _ = rolling.camera.project(xyz)
    assert np.linalg.norm(late - expected, axis=1).max() > 5.0
    straight = rolling.straightened(seen_as(rolling.camera, late, 1.0 / xyz[:, 2]), TWIST)
    # float32 pixels, and the depth of the stamp for that of the reading: 1 % of it, of the shift by the velocity
    np.testing.assert_allclose(straight.px, expected, atol=0.15)
    np.testing.assert_allclose(straight.ray, rolling.camera.unproject(expected)[0], atol=5e-4)


def test_corners_without_depth_turn_and_do_not_shift():
    rolling, xyz = shutter(), 1000.0 * points(np.random.default_rng(1))
    late = rolled(rolling.camera, xyz, TWIST)
    straight = rolling.straightened(seen_as(rolling.camera, late, np.zeros(len(xyz))), TWIST)
    np.testing.assert_allclose(straight.px, rolling.camera.project(xyz)[0], atol=0.02)  # float32, third order
    assert not straight.inv_depth.any()


def test_a_corner_may_leave_the_image_by_a_tenth_of_it_and_no_farther():
    rolling = shutter()
    px = np.array([[638.0, 470.0], [320.0, 240.0]])
    seen = seen_as(rolling.camera, px, np.zeros(2))
    past = rolling.straightened(seen, np.array([0.0, 4.0, 0.0, 0.0, 0.0, 0.0]))
    assert past.px[0, 0] > 640.0
    far = rolling.straightened(seen, np.array([0.0, 20.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(far.px[0], seen.px[0])  # left as it was: no turn of a hand
    assert far.px[1, 0] > seen.px[1, 0]


def test_a_global_shutter_changes_nothing():
    still, xyz = shutter(row_time_s=0.0), points(np.random.default_rng(2))
    seen = seen_as(still.camera, still.camera.project(xyz)[0], 1.0 / xyz[:, 2])
    assert not still.rolls
    assert still.straightened(seen, TWIST) is seen


@pytest.mark.parametrize("seed", range(3))
def test_the_turn_is_read_from_the_rows_with_the_pose_unknown(seed):
    # Corners of 0.7 px and a pose that is off: the pose explains what all rows share, the turn what grows along them.
    rng = np.random.default_rng(seed)
    rolling, xyz = shutter(), points(rng, 250)
    twist = np.append(rng.uniform(-2.5, 2.5, 3), rng.normal(0, 0.05, 3))
    px = rolled(rolling.camera, xyz, twist) + rng.normal(0, 0.7, (len(xyz), 2))
    off = SE3.exp(rng.normal(0, [0.01] * 3 + [0.01] * 3))
    found, seen = np.zeros(6), seen_as(rolling.camera, px, 1.0 / xyz[:, 2])
    for _ in range(3):
        more = np.zeros(6)
        more[:3] = rolling.turn_left_over(seen.px, np.full(len(px), 0.7), off @ xyz, -found[:3], 10.0 * np.eye(3))
        found, seen = found + more, rolling.straightened(seen, more)
    # 0.7 px over 250 corners against 14 ms and 400 px: 0.03 rad/s, half more about the axis, thrice that
    # and what the velocity takes over
    np.testing.assert_allclose(found[:3], twist[:3], atol=0.2)


def test_few_corners_leave_the_turn_at_what_is_known_without_them():
    rolling, xyz = shutter(), points(np.random.default_rng(3), 3)
    px, _ = rolling.camera.project(xyz)
    known = np.array([0.3, -0.2, 0.1])
    turn = rolling.turn_left_over(px + np.array([3.0, 0.0]), np.ones(3), xyz, known, np.eye(3))
    assert np.abs(turn - known).max() < 0.1
