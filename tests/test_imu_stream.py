"""Samples that come twice, late, out of order, with holes or in the wrong unit: told, and survived."""

from __future__ import annotations

import numpy as np
import pytest

from lodelight.imu.samples import ImuSamples
from lodelight.imu.stream import ImuStream
from lodelight.imu.units import accelerometer_fault, gyroscope_fault
from lodelight.imu.vibration import Vibration
from lodelight.messages import Imu
from lodelight.rig import ImuSpec

MS = 1_000_000
UP = np.array([0.0, 0.0, 9.81])


def sample(t_ms: float, value: float = 0.0) -> Imu:
    return Imu(round(t_ms * MS), np.full(3, value), UP)


@pytest.fixture
def stream() -> tuple[ImuStream, list[str]]:
    told: list[str] = []
    return ImuStream(ImuSpec(rate_hz=200.0), lambda t_ns, kind, **f: told.append(f["why"])), told


def test_samples_out_of_order_are_put_in_place(stream):
    buffer, told = stream
    for t in (0, 5, 15, 10, 20):
        buffer.add(sample(t, t))
    found = buffer.between(0, 20 * MS)
    assert found.t_ns.tolist() == [0, 5 * MS, 10 * MS, 15 * MS, 20 * MS]
    assert found.gyro[:, 0].tolist() == [0, 5, 10, 15, 20]
    assert "5.0 ms out of order" in told[0]


def test_the_second_sample_of_a_stamp_and_one_that_is_no_number_are_left_out(stream):
    buffer, told = stream
    for s in (sample(0), sample(5, 1.0), sample(5, 2.0), sample(7, np.nan), sample(10)):
        buffer.add(s)
    assert len(buffer) == 3
    assert buffer.faults == {"twice": 1, "not a number": 1}
    assert len(told) == 2


def test_a_sample_for_a_time_that_was_already_used_is_left_out(stream):
    buffer, told = stream
    for t in (0, 5, 10):
        buffer.add(sample(t))
    buffer.between(0, 10 * MS)
    buffer.add(sample(7))
    assert len(buffer) == 3
    assert "3 ms late" in told[0]


def test_ends_are_interpolated_and_old_samples_are_forgotten(stream):
    buffer, _ = stream
    for t in range(0, 105, 5):
        buffer.add(sample(t, t))
    found = buffer.between(round(12.5 * MS), round(52 * MS))
    assert found.gyro[0, 0] == pytest.approx(12.5)
    assert found.gyro[-1, 0] == pytest.approx(52)
    buffer.forget_before(50 * MS)
    assert buffer.between(50 * MS, 100 * MS).gyro[0, 0] == pytest.approx(50)
    assert len(buffer) < 13


def test_a_gap_is_told_and_a_long_one_is_not_bridged(stream):
    buffer, told = stream
    for t in (0, 5, 105, 110, 900):
        buffer.add(sample(t))
    assert "no samples for 100 ms" in told[0]
    assert isinstance(buffer.between(0, 110 * MS), ImuSamples)
    assert "no IMU for 0.79 s" in buffer.between(5 * MS, 900 * MS)


def test_stamps_of_another_clock_are_named(stream):
    buffer, _ = stream
    assert buffer.between(0, 1) == "no IMU sample has come yet"
    buffer.add(sample(0))
    answer = buffer.between(3_600_000 * MS, 3_600_050 * MS)
    assert "end before it, by 3.6e+03 s" in answer
    assert "another clock" in answer


@pytest.mark.parametrize(
    ("scale", "word"),
    [(1.0, ""), (1 / 9.80665, "in g"), (1000.0, "in mm/s^2"), (102.0, "in mg"), (30.0, "check its unit")],
)
def test_the_unit_of_an_accelerometer_is_known_by_gravity(scale, word):
    accel = UP + np.random.default_rng(0).normal(0, 2.0, (200, 3))
    fault = accelerometer_fault(scale * accel)
    assert word in fault
    assert bool(fault) == bool(word)


@pytest.mark.parametrize(
    ("scale", "word"), [(1.0, ""), (180 / np.pi, "in deg/s"), (-1.0, "the other way round"), (0.0, "")]
)
def test_the_unit_of_a_gyroscope_is_known_by_the_images(scale, word):
    rng = np.random.default_rng(1)
    seen = 0.02 * np.sin(np.arange(30)[:, None] * 0.4 + np.arange(3))
    turned = scale * (seen + 0.001 * rng.standard_normal(seen.shape)) + 0.05 * 0.05
    fault = gyroscope_fault(turned, seen, 1.5)
    if scale == 0.0:
        assert "check its axes" in fault  # it says nothing while the images turn
    else:
        assert word in fault
        assert bool(fault) == bool(word)


def test_a_bias_at_rest_is_no_wrong_unit():
    turned = np.tile([0.0, 0.01, 0.005], (20, 1))  # 0.2 rad/s
    assert gyroscope_fault(turned, np.zeros((20, 3)), 1.0) == ""


def test_vibration_raises_the_accelerometers_noise_and_white_noise_of_the_data_sheet_does_not():
    spec, rng = ImuSpec(), np.random.default_rng(2)
    t_ns = np.arange(0, 2_000 * MS, 5 * MS)

    def noise_of(sigma: float) -> float:
        vibration = Vibration(spec, 0.4)
        accel = UP + rng.normal(0, sigma, (len(t_ns), 3))
        for i in range(0, len(t_ns) - 10, 10):
            found = vibration.add(ImuSamples(t_ns[i : i + 11], np.zeros((11, 3)), accel[i : i + 11]))
        return found.accel_noise

    assert noise_of(spec.accel_noise * np.sqrt(200.0)) == spec.accel_noise
    assert noise_of(1.0) == pytest.approx(0.4 / np.sqrt(200.0), rel=0.2)
