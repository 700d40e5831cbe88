"""Each fault is named with its amount, and none where there is none: on a simulated walk, and on a real flight."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import shared_data
from lodelight.anchors import tag_corners
from lodelight.cli.main import main
from lodelight.doctor import signals
from lodelight.doctor.examine import judge
from lodelight.doctor.gather import Pair, Seen, blur_of, matched
from lodelight.doctor.rims import beside, rims_of
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp, so3_log
from lodelight.messages import Imu, TagSighting
from lodelight.rig import CameraSpec, ImuSpec, Rig

T0 = 1_600_000_000_000_000_000
LENS = Camera.create("radtan", 752, 480, (458.0, 457.0, 367.0, 248.0), (-0.28, 0.074, 0.0002, 2e-5))
# camera 0 looks along x of the body, as on a robot; camera 1 stands 0.11 m to its right
R_BODY_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


BIAS = np.array([0.01, -0.02, 0.015])


def rig(turn_deg=(0, 0, 0), shift_m=(0, 0, 0), focal=1.0):
    """The rig as written down: each argument is by how much it is wrong, cam1's alone for the shift."""
    fx, fy, cx, cy = LENS.params[:4].tolist()
    lens = Camera.create("radtan", 752, 480, (fx * focal, fy * focal, cx, cy), LENS.distortion)
    turn = np.radians(np.array(turn_deg, dtype=float))
    R = R_BODY_CAM @ so3_exp(turn)
    right = np.array([0.05, -0.11, 0.0]) + np.array(shift_m, dtype=float)
    cam0 = CameraSpec("cam0", lens, SE3(R, np.array([0.05, 0.0, 0.0])), 20.0)
    cam1 = CameraSpec("cam1", lens, SE3(R, right), 20.0)
    return Rig((cam0, cam1), imu=ImuSpec())


def body_at(t_s):
    """A walk that turns about all axes."""
    w = 2 * np.pi
    turn = np.array([0.15 * np.sin(w * 0.7 * t_s), 0.2 * np.sin(w * 0.5 * t_s + 1), 0.9 * np.sin(w * 0.35 * t_s)])
    at = np.array([0.8 * t_s, 0.3 * np.sin(w * 0.4 * t_s), 0.03 * np.sin(w * 1.8 * t_s)])
    return SE3(so3_exp(np.array([0, 0, turn[2]])) @ so3_exp(turn * [1, 1, 0]), at)


def walk(seed=0, noise_px=0.1, seconds=4.0):
    """What `look` would have gathered from a walk through a cloud of points: with noise and a walker among them."""
    rng = np.random.default_rng(seed)
    true = rig()
    world = rng.uniform([-2, -5, -2], [18, 5, 2], (3000, 3))
    imu, dt = [], 0.005
    for k in range(int((seconds + 1.2) / dt)):
        t = k * dt - 0.6
        gyro = so3_log(body_at(t - 5e-4).R.T @ body_at(t + 5e-4).R) / 1e-3
        noise = rng.normal(scale=2.4e-3, size=3)
        h = 2e-3
        pull = (body_at(t - h).t - 2.0 * body_at(t).t + body_at(t + h).t) / h**2 + np.array([0.0, 0.0, 9.81])
        accel = body_at(t).R.T @ pull + np.array([0.05, -0.1, 0.08]) + rng.normal(scale=0.03, size=3)
        imu.append(Imu(T0 + round(t * 1e9), gyro + BIAS + noise, accel))
    pairs, stereo = [], []
    for k in range(int(seconds / 0.15)):
        a, b = 0.15 * k, 0.15 * (k + 1)
        views = [(body_at(t) @ spec.T_body_cam).inverse() @ world for t in (a, b) for spec in true.cameras]
        px = [LENS.project(X)[0] for X in views]
        ok = np.all(
            [(X[:, 2] > 0.7) & (X[:, 2] < 9) & LENS.inside(p, 5) for X, p in zip(views, px, strict=True)], axis=0
        )
        chosen = rng.permutation(np.flatnonzero(ok))[:120]
        left_a, right_a, left_b = (px[i][chosen] + rng.normal(scale=noise_px, size=(len(chosen), 2)) for i in (0, 1, 2))
        left_b[:12] += rng.uniform(3, 12, 2)  # somebody walks through the picture
        t_a, t_b = T0 + round(a * 1e9), T0 + round(b * 1e9)
        pairs.append(Pair(t_a, t_b, left_a, left_b, right_a, np.zeros(len(chosen))))
        stereo.append((left_a, right_a))
    stamps = T0 + np.arange(round(seconds * 20)) * 50_000_000
    return Seen(pairs, stereo, [(110.0, 0.01, 0.01)] * 10, [0.3] * 10, imu, stamps)


@pytest.fixture(scope="module")
def walked():
    return walk()


def faults(seen, stated):
    return {f.name: f for f in judge(seen, stated) if f.level == "fault"}


@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_named_where_nothing_is_wrong(seed):
    assert faults(walk(seed, noise_px=0.05 + 0.15 * seed), rig()) == {}


@pytest.mark.parametrize("ms", [5.0, -5.0, -200.0])
def test_a_time_offset_is_named_with_its_amount(walked, ms):
    shifted = [Imu(s.t_ns + round(ms * 1e6), s.gyro, s.accel) for s in walked.imu]
    found = faults(replace(walked, imu=shifted), rig())
    assert set(found) == {"time offset"}
    assert found["time offset"].value == pytest.approx(ms, abs=1.0)


@pytest.mark.parametrize("axis", [0, 2])
def test_cameras_turned_by_three_degrees_against_the_imu_are_named(walked, axis):
    found = faults(walked, rig(turn_deg=3.0 * np.eye(3)[axis]))
    assert set(found) == {"IMU turn"}
    assert found["IMU turn"].value == pytest.approx(3.0, abs=0.5)


@pytest.mark.parametrize("axis", [0, 2])
def test_a_camera_three_centimetres_beside_its_place_is_named(walked, axis):
    found = faults(walked, rig(shift_m=0.03 * np.eye(3)[axis]))
    assert "stereo shift" in found
    assert found["stereo shift"].value == pytest.approx(3.0, abs=0.5)


def test_a_camera_turned_against_the_other_is_named(walked):
    stated = rig()
    wrong = replace(
        stated.cameras[1], T_body_cam=stated.cameras[1].T_body_cam.perturbed(np.radians([0, 2.0, 2.2, 0, 0, 0]))
    )
    found = faults(walked, replace(stated, cameras=(stated.cameras[0], wrong)))
    assert found["stereo turn"].value == pytest.approx(2.97, abs=0.3)


@pytest.mark.parametrize(("factor", "cameras"), [(1.03, 2), (0.97, 2), (1.03, 1)])
def test_a_focal_length_wrong_by_three_percent_is_named(walked, factor, cameras):
    stated = rig(focal=factor)
    found = faults(walked, replace(stated, cameras=stated.cameras[:cameras]))
    assert found["focal length"].value == pytest.approx(100 * (1 / factor - 1), abs=0.6)


def test_a_gyro_in_degrees_and_nothing_else_is_named(walked):
    degrees = [Imu(s.t_ns, np.degrees(s.gyro), s.accel) for s in walked.imu]
    found = faults(replace(walked, imu=degrees), rig())
    assert set(found) == {"gyro unit"}


def test_swapped_cameras_and_nothing_else_are_named(walked):
    swapped = replace(walked, stereo=[(b, a) for a, b in walked.stereo])
    assert set(faults(swapped, rig())) == {"swapped cameras"}


def test_a_motion_that_does_not_turn_says_so(walked):
    still = [replace(p, b_px=p.a_px) for p in walked.pairs]
    rest = [Imu(s.t_ns, np.zeros(3), s.accel) for s in walked.imu]
    findings = judge(replace(walked, pairs=still, imu=rest), rig())
    assert not [f for f in findings if f.level == "fault"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pair_three_centimetres_beside_its_place_on_the_imu_is_named(axis):
    seen, stated = walk(1, seconds=12.0), rig()
    cameras = [
        replace(c, T_body_cam=SE3(c.T_body_cam.R, c.T_body_cam.t + 0.03 * np.eye(3)[axis])) for c in stated.cameras
    ]
    findings = {f.name: f for f in judge(seen, replace(stated, cameras=tuple(cameras)))}
    shift = findings["IMU shift"]
    assert {f.name for f in findings.values() if f.level == "fault"} == {"IMU shift"}
    assert shift.value == pytest.approx(3.0, abs=1.0)
    assert judge_shift(seen, stated).level == "ok"


def judge_shift(seen, stated):
    return next(f for f in judge(seen, stated) if f.name == "IMU shift")


def tags_of(seed, count=60, noise_px=0.1):
    """Sightings of tags of 20 cm from all sides, as the true lens shows them."""
    rng, out = np.random.default_rng(seed), []
    while len(out) < count:
        turn = rng.normal(size=3)
        T = SE3(np.diag([1.0, 1.0, 1.0]) @ so3_exp(0.7 * turn), rng.uniform([-0.5, -0.3, 0.4], [0.5, 0.3, 1.0]))
        px, seen = LENS.project(T @ tag_corners(0.2))
        if seen.all() and LENS.inside(px).all() and T.R[2, 2] > 0.3:
            px = px + rng.normal(scale=noise_px, size=(4, 2))
            out.append(TagSighting(len(out), "tag36h11", str(len(out)), px, np.full(4, noise_px)))
    return out


def test_tags_that_are_no_squares_tell_of_the_lens(walked):
    seen = replace(walked, tags=tags_of(0))
    assert faults(seen, rig()) == {}
    for factor in (1.03, 0.97):
        found = faults(seen, replace(rig(focal=factor), imu=None))
        assert found["tag focal"].value == pytest.approx(100 * (1 / factor - 1), abs=0.5)
        assert "tag aspect" not in found
    fx, fy, cx, cy = LENS.params[:4].tolist()
    flat = Camera.create("radtan", 752, 480, (fx, 1.03 * fy, cx, cy), LENS.distortion)
    one = replace(rig(), cameras=(replace(rig().cameras[0], camera=flat),), imu=None)
    found = faults(replace(seen, pairs=[], stereo=[]), one)
    assert found["tag aspect"].value == pytest.approx(3.0, abs=0.5)


# -- one sensor by itself ----------------------------------------------------------------------------------------------


def boxes(seed, shift_m=(0.0, 0.0), turn_rad=(0.0, 0.0), frames=12):
    """Rims of boxes 1 to 3.5 m away before a wall at 5 m, as by a depth sensor that stands otherwise than is stated."""
    rng = np.random.default_rng(seed)
    seen, focal = [], LENS.focal_px
    for _ in range(frames):
        image = rng.normal(90.0, 12.0, (LENS.height, LENS.width)).astype(np.float32)
        depth = np.full(image.shape, 5.0, np.float32)
        for z in -np.sort(-rng.uniform(1.0, 3.5, 7)):  # the farthest first
            half = focal * 0.15 / z
            middle = rng.uniform(half, [LENS.width - half, LENS.height - half])
            for picture, value, moved in ((image, rng.uniform(0, 255), 0.0), (depth, z, 1.0)):
                at = middle + moved * focal * (np.array(turn_rad) + np.array(shift_m) / z)
                (x0, y0), (x1, y1) = (np.clip(np.rint(at + s * half), 0, None).astype(int) for s in (-1, 1))
                picture[y0:y1, x0:x1] = value
        image = cv2.GaussianBlur(image, (0, 0), 0.8).clip(0, 255).astype(np.uint8)
        depth[rng.random(depth.shape) < 0.02] = 0.0
        seen.append(rims_of(image, depth, focal))
    return beside(seen)


@pytest.mark.parametrize("seed", range(3))
def test_depth_that_lies_on_the_image_is_found_there(seed):
    found = boxes(seed)
    assert np.hypot(*found.px) < 1.5
    assert found.sigma_px < 1.5


@pytest.mark.parametrize("axis", [(0.03, 0.0), (0.0, -0.03)])
def test_a_depth_sensor_three_centimetres_beside_its_place_is_found_by_the_rims_of_things(axis):
    found = boxes(3, shift_m=axis)
    for distance_m, x, y in found.bands:
        np.testing.assert_allclose([x, y], LENS.focal_px * np.array(axis) / distance_m, atol=2.0)
    assert np.hypot(*found.px) > 4.0 * found.sigma_px
    assert len(found.bands) > 1


def test_a_depth_sensor_turned_by_three_degrees_is_found_by_the_rims_of_things():
    turn = np.radians([2.4, -1.8])
    found = boxes(4, turn_rad=turn)
    np.testing.assert_allclose(found.px, LENS.focal_px * turn, atol=2.0)


def test_images_without_rims_tell_nothing():
    assert beside([]) is None
    assert beside([rims_of(np.full((60, 80), 7, np.uint8), np.zeros((60, 80), np.float32), 80.0)] * 9) is None


def test_stamps_with_gaps_and_disorder_are_told_with_their_amount():
    good = T0 + np.arange(200) * 50_000_000
    assert {f.level for f in signals.stamps(good, 20.0, ())} == {"ok"}
    gap = np.delete(good, np.arange(100, 120))
    assert [f.name for f in signals.stamps(gap, 20.0, ()) if f.level == "fault"] == ["frame gaps"]
    assert "1.050 s" in signals.stamps(gap, 20.0, ())[1].text
    back = good.copy()
    back[10:30] = good[30:10:-1]
    assert "fault" in {f.level for f in signals.stamps(back, 20.0, ())}
    assert signals.stamps(good, 30.0, ())[0].level == "note"


@pytest.mark.parametrize(("accel", "says"), [((0, 0, 1.0), "in g"), ((0.1, 0.2, 0.1), "removed"), ((0, 0, 9.79), "")])
def test_units_of_the_accelerometer(accel, says):
    samples = [Imu(T0 + 5_000_000 * k, np.zeros(3), np.array(accel, float)) for k in range(400)]
    found = signals.inertial(samples, np.array([T0, T0 + 10**9]), 200.0)
    assert [says in f.text for f in found if f.level == "fault"] == ([True] if says else [])


def test_black_white_and_blurred_images_are_told():
    assert signals.exposure([(110, 0.02, 0.01)] * 9).level == "ok"
    assert "black" in signals.exposure([(2, 0.97, 0.0)] * 9).text
    assert signals.exposure([(250, 0.0, 0.8)] * 9).level == "fault"
    import cv2

    sharp = np.random.default_rng(0).integers(0, 256, (240, 320)).astype(np.uint8)
    soft = cv2.GaussianBlur(sharp.astype(np.float32), (0, 0), 8)
    soft = cv2.normalize(soft, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    assert blur_of(sharp) < 0.3
    assert blur_of(soft) > 0.75
    assert signals.blur([blur_of(soft)] * 5).level == "fault"


def test_matches_of_two_images_are_found_without_a_rig():
    rng = np.random.default_rng(3)
    import cv2

    image = cv2.GaussianBlur(rng.integers(0, 256, (240, 320)).astype(np.uint8), (0, 0), 1.5)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    a, b = matched(image[:, 20:], image[:, :-20])
    assert len(a) > 50
    assert np.allclose(np.median(b - a, axis=0), [20, 0], atol=0.1)


def test_the_command_on_a_real_flight_names_nothing_and_status_is_0(capsys):
    assert main(["doctor", str(shared_data("euroc_mh05")), "--json"]) == 0
    assert '"fault"' not in capsys.readouterr().out
