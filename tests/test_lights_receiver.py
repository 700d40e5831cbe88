"""Modulation and receiver, on simulated images and a real photo."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import shared_data
from light_scenes import CODES_HZ, EXPOSURE_S, LIGHTS, ROW_S, SPEC, crop, paint
from lodelight.anchors import Light
from lodelight.errors import CalibrationError, ConfigError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.lights.calibrate import calibrate_row_time
from lodelight.lights.modulation import Manchester, Pwm, contrast, flicker, null_hz
from lodelight.lights.odometry import LightOdometry
from lodelight.lights.plan import colour, frequencies, plan_frequencies
from lodelight.lights.receiver import receiver
from lodelight.rig import CameraSpec

RECEIVER = receiver(SPEC, LIGHTS)


@pytest.mark.parametrize("code", [Pwm(3100.0, 0.3, 0.2), Manchester(0b01101001, 8, 1.0 / 9000.0)])
def test_the_mean_over_an_exposure_is_that_of_many_instants(code):
    start = np.linspace(0.0, 2e-3, 50)
    instants = start[:, None] + (np.arange(4000) + 0.5) / 4000 * EXPOSURE_S
    sampled = code.mean(instants.ravel(), 1e-12).reshape(instants.shape).mean(axis=1)
    # 4000 instants and at most three switchings: 1e-3 at most, and rounding
    np.testing.assert_allclose(code.mean(start, EXPOSURE_S), sampled, atol=1.5e-3)


def test_contrast_is_the_fundamental_of_the_rows_and_vanishes_where_a_period_is_one_exposure():
    start = np.arange(4096) / 4096 / 3000.0
    rows = Pwm(3000.0, 0.4).mean(start, EXPOSURE_S)
    assert 2.0 * abs(np.fft.rfft(rows)[1]) / len(rows) == pytest.approx(contrast(3000.0, 0.4, EXPOSURE_S), rel=1e-5)
    assert contrast(null_hz(EXPOSURE_S), 0.5, EXPOSURE_S) == pytest.approx(0.0, abs=1e-12)


def test_flicker_limits_are_those_of_ieee_1789():
    assert [flicker(f) for f in (200.0, 1249.0, 1251.0, 2990.0, 3010.0)] == [
        "visible", "visible", "low risk", "low risk", "no effect",
    ]  # fmt: skip


@pytest.mark.parametrize("bell", [False, True])
@pytest.mark.parametrize("level", [180.0, 600.0])  # within the eight bits, and far beyond them
def test_frequency_and_centre_of_a_light_are_found(bell, level):
    for diameter, largest_rms_hz, largest_rms_px in ((40, 12.0 if bell or level > 255 else 5.0, None), (60, 10.0, 0.1)):
        rng = np.random.default_rng(diameter)
        off_hz, off_px = [], []
        for _ in range(40):
            least = 2.7 / (diameter * ROW_S)
            frequency = rng.choice(CODES_HZ[least < CODES_HZ])
            image, centre = crop(rng, diameter, frequency, bell, level)
            (seen,) = RECEIVER.sightings(image, 0)
            assert seen.id in (None, f"{frequency:.0f}")
            off_hz.append(seen.frequency_hz - frequency)
            off_px.append(seen.centre_px - centre)
        if not (bell and level > 255):  # a saturated bell has few honest rows: 30 Hz
            assert np.sqrt(np.mean(np.square(off_hz))) < largest_rms_hz * (1.5 if bell else 1.0)
        if largest_rms_px and not (bell and level > 255):
            assert np.sqrt(np.mean(np.square(off_px))) < largest_rms_px


def test_no_identity_is_wrong_and_too_few_stripes_are_refused():
    rng = np.random.default_rng(5)
    named = 0
    for _ in range(250):
        diameter, frequency = rng.uniform(20.0, 120.0), rng.choice(CODES_HZ)
        image, _ = crop(rng, diameter, frequency)
        for seen in RECEIVER.sightings(image, 0):
            assert seen.id in (None, f"{frequency:.0f}"), (diameter, frequency, seen)
            if frequency * diameter * ROW_S < 2.45:  # two per cent below what is needed
                assert seen.id is None
            named += seen.id is not None
            assert seen.id or seen.why
    assert named > 150


def test_a_steady_lamp_a_window_and_a_cut_light_are_refused_with_the_reason():
    rng = np.random.default_rng(2)
    discs = [
        (np.array([200.3, 300.0]), 80.0, None),
        (np.array([600.0, 500.0]), 80.0, Pwm(3000.0)),
        (np.array([1270.0, 700.0]), 80.0, Pwm(4000.0)),
    ]
    image = paint((960, 1280), discs, rng)
    image[100:200, 400:900] = 200
    seen = RECEIVER.sightings(image, 0)
    assert [s.id for s in seen if s.id] == ["3000"]
    why = sorted(s.why for s in seen if not s.id)
    assert any("border" in w for w in why)
    assert any("not round" in w for w in why)
    assert len(why) == 3


def test_two_lights_of_one_frequency_in_view_have_no_name():
    rng = np.random.default_rng(3)
    discs = [(np.array([300.0 + 300 * i, 400.0]), 80.0, Pwm(3000.0, 0.5, 0.3 * i)) for i in range(2)]
    seen = RECEIVER.sightings(paint((960, 1280), discs, rng), 0)
    assert [s.id for s in seen] == [None, None]
    assert all("2 spots" in s.why for s in seen)


def test_an_unknown_frequency_has_no_name():
    rng = np.random.default_rng(4)
    seen = RECEIVER.sightings(paint((400, 400), [(np.array([200.0, 200.0]), 90.0, Pwm(3100.0))], rng), 0)
    assert [s.id for s in seen] == [None]
    assert "no light's" in seen[0].why


def test_the_stamp_is_that_of_the_centre_row_and_a_turned_image_gives_the_same():
    rng = np.random.default_rng(6)
    image = paint((960, 1280), [(np.array([400.2, 700.4]), 80.0, Pwm(3000.0))], rng)
    (seen,) = RECEIVER.sightings(image, 1_000_000_000)
    expected = 1_000_000_000 + (700.4 * ROW_S + 0.5 * EXPOSURE_S) * 1e9
    assert seen.t_ns == pytest.approx(expected, abs=0.1 * ROW_S * 1e9)  # a tenth of a row
    (turned,) = receiver(SPEC, LIGHTS, "columns").sightings(np.ascontiguousarray(image.T), 1_000_000_000)
    np.testing.assert_array_equal(turned.centre_px, seen.centre_px[::-1])
    assert (turned.t_ns, turned.id) == (seen.t_ns, seen.id)


def test_manchester_words_are_read_through_the_same_receiver():
    words = ["01101001", "00010111", "11100010", "10101100"]
    lights = tuple(Light(w, 12_000.0, np.zeros(3), word=w) for w in words)
    reader = receiver(SPEC, lights)
    rng = np.random.default_rng(7)
    for word in words * 4:
        code = Manchester(int(word, 2), 8, 1.0 / 12_000.0)
        offset = rng.uniform(0.0, 0.01)
        code_at = type("Late", (), {"mean": lambda _, t, e, c=code, o=offset: c.mean(t + o, e)})()
        image = paint((400, 400), [(rng.uniform(190, 210, 2), 180.0, code_at)], rng)
        assert [s.id for s in reader.sightings(image, 0)] == [word]


def test_the_row_time_is_found_from_a_known_light():
    rng = np.random.default_rng(8)
    images = [crop(rng, 90, 3000.0)[0] for _ in range(3)]
    found = calibrate_row_time(images, 3000.0, SPEC)
    assert found.row_time_s == pytest.approx(ROW_S, rel=1e-3)  # 1 Hz of 3000, and a little
    assert abs(found.row_time_s - ROW_S) < 5.0 * found.sigma_s


def test_what_cannot_be_read_is_refused_at_once():
    with pytest.raises(CalibrationError, match="no light camera"):
        receiver(None, LIGHTS)
    with pytest.raises(CalibrationError, match="row_time_s"):
        receiver(CameraSpec("light0", SPEC.camera, SPEC.T_body_cam), LIGHTS)
    with pytest.raises(ConfigError, match="no light"):
        receiver(SPEC, ())


def test_the_lights_of_a_real_photo_are_named():
    folder = shared_data("led_photos")
    facts = json.loads((folder / "rig.json").read_text())
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imread(str(folder / "x_0_y_1.27.jpg"), flags)
    lights = tuple(Light(k, float(k), np.array(v) / 100) for k, v in facts["test_rig_transmitters_cm"].items())
    lens = Camera.create("radtan", *facts["camera"]["landscape_size"], (5620.0, 5620.0, 3855.5, 2175.5))
    spec = CameraSpec("phone", lens, SE3.identity(), row_time_s=facts["camera"]["row_time_s"], exposure_s=EXPOSURE_S)
    seen = {s.id: s for s in receiver(spec, lights).sightings(image, 0) if s.id}
    for name in ("2500", "3500", "4000"):  # those the rig file says are seen
        assert seen[name].frequency_hz == pytest.approx(float(name), rel=0.01)
    # The published map is one seen from below: as it stands it has the wrong hand
    with pytest.raises(CalibrationError, match="mirror"):
        LightOdometry(spec, lights, sigma_tilt_deg=2.0, sigma_floor_px=1.0).locate(list(seen.values()))
    turned = tuple(replace(light, xyz=light.xyz * [-1, 1, 1]) for light in lights)
    fix = LightOdometry(spec, turned, sigma_tilt_deg=2.0, sigma_floor_px=1.0).locate(list(seen.values()))
    assert len(fix.lights) == 5
    assert fix.rms_px < 6.0


def test_a_plan_keeps_lights_of_one_frequency_apart_and_says_when_it_cannot():
    grid = [(x, y) for x in range(12) for y in range(12)]
    lights = tuple(Light(f"L{i}", 1.0, np.array([1.5 * x, 1.5 * y, 3.0])) for i, (x, y) in enumerate(grid))
    plan = plan_frequencies(lights, SPEC, camera_height_m=0.5)
    assert plan.reuse_m >= plan.reach_m
    assert set(np.diff(plan.codes_hz)) == {200.0}
    assert 2.5 / (plan.diameter_rows * ROW_S) <= plan.codes_hz[0]
    with pytest.raises(ConfigError, match="too few"):
        plan_frequencies(lights, SPEC, 0.5, reach_m=14.0)
    with pytest.raises(ConfigError, match="no frequency"):
        frequencies(ROW_S, EXPOSURE_S, diameter_rows=10.0)


def test_colours_never_meet_where_enough_exist():
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, 10.0, (40, 2))
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    code = colour(apart, 40, 20.0)
    assert sorted(code) == list(range(40))
