"""IMU preintegration: against exact motion, central differences, Monte Carlo and GTSAM."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from inertial_scenes import scene, state_error
from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_log
from lodelight.imu.preintegration import GRAVITY, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec
from test_inertial_factors import differences, shaken

SPEC = ImuSpec()


def difference(a, b):
    """(rotation, dp, dv) from a to b."""
    return np.concatenate([so3_log(np.ascontiguousarray(a[0].T @ b[0])), b[1] - a[1], b[2] - a[2]])


def parts(p):
    return p.dR, p.dp, p.dv


def test_a_perfect_imu_carries_the_state_along_for_ten_seconds():
    """Below a millimetre at 200 Hz (science note E), between stamps that fall between the samples."""
    made = scene(3, gait="drone", duration_s=11.0, imu="perfect")
    start, end = int(made.frame_ns[5]), int(made.frame_ns[205])
    state = made.truth(start)
    predicted = state.predicted(
        preintegrate(made.samples.between(start, end), state.bias_gyro, state.bias_accel, made.rig.imu)
    )
    error = state_error(predicted, made.truth(end))
    assert np.linalg.norm(error[3:6]) < 1e-3
    assert np.linalg.norm(error[:3]) < 1e-4


def test_bias_jacobians_match_central_differences():
    rng = np.random.default_rng(1)
    samples, bias = shaken(rng), rng.normal(size=6) * 0.05
    found = preintegrate(samples, bias[:3], bias[3:], SPEC)

    def other(d):
        return difference(parts(found), parts(preintegrate(samples, bias[:3] + d[:3], bias[3:] + d[3:], SPEC)))

    # that of the rotation takes J_r at the whole step, not at its half: an error of dt |w| / 12
    np.testing.assert_allclose(found.jacobian, differences(other, 6), atol=2e-6)


def test_corrected_is_first_order_and_repropagated_is_exact():
    rng = np.random.default_rng(2)
    samples, bias = shaken(rng), np.zeros(6)
    found, moved = preintegrate(samples, bias[:3], bias[3:], SPEC), rng.normal(size=6) * 1e-3
    exact = found.repropagated(moved[:3], moved[3:])
    assert np.abs(difference(found.corrected(moved[:3], moved[3:]), parts(exact))).max() < 1e-6
    assert np.abs(difference(parts(found), parts(exact))).max() > 1e-4
    assert not found.moved(moved[:3], moved[3:])
    assert found.moved(np.array([0.02, 0.0, 0.0]), np.zeros(3))


def test_in_pieces_is_as_at_once():
    samples = shaken(np.random.default_rng(3))
    whole = preintegrate(samples, np.zeros(3), np.zeros(3), SPEC)
    first, then = samples.between(0, 83_000_000), samples.between(83_000_000, int(samples.t_ns[-1]))
    joined = preintegrate(first, np.zeros(3), np.zeros(3), SPEC).extended(then)
    # the extra stamp splits one midpoint step in two
    assert np.abs(difference(parts(whole), parts(joined))).max() < 1e-4
    cut = ImuSamples(samples.t_ns[:21], samples.gyro[:21], samples.accel[:21])
    rest = ImuSamples(samples.t_ns[20:], samples.gyro[20:], samples.accel[20:])
    again = preintegrate(cut, np.zeros(3), np.zeros(3), SPEC).extended(rest)
    # the steps are differences of other times: the last digits differ
    np.testing.assert_allclose(again.covariance, whole.covariance, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(again.jacobian, whole.jacobian, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(again.dp, whole.dp, rtol=1e-12)
    assert np.array_equal(again.samples.t_ns, samples.t_ns)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_covariance_is_that_of_many_noisy_runs(seed):
    """With its correlation to the walk of the biases, as the residual has it: truth less what was measured.

    Normalized squares of 400 runs in n dimensions average to n within sqrt(2 / n / 400) of it: bounds at 4 of them.
    """
    rng = np.random.default_rng(seed)
    spec = ImuSpec(200.0, 2e-3, 2e-3, 2e-2, 3e-2)  # walks that matter within the second
    clean = shaken(rng, 201)
    clean = ImuSamples(clean.t_ns, np.cumsum(clean.gyro, axis=0) * 0.1, np.cumsum(clean.accel, axis=0) * 0.03)
    dt = 0.005
    truth = preintegrate(clean, np.zeros(3), np.zeros(3), spec)
    squares = []
    for _ in range(400):
        white = rng.normal(size=(2, 201, 3)) / np.sqrt(dt)
        walk = np.cumsum(rng.normal(size=(2, 201, 3)) * np.sqrt(dt), axis=1)
        walk -= walk[:, :1]
        gyro = clean.gyro + spec.gyro_noise * white[0] + spec.gyro_walk * walk[0]
        accel = clean.accel + spec.accel_noise * white[1] + spec.accel_walk * walk[1]
        noisy = preintegrate(ImuSamples(clean.t_ns, gyro, accel), np.zeros(3), np.zeros(3), spec)
        d = difference(parts(noisy), parts(truth))
        d = np.concatenate([d, spec.gyro_walk * walk[0, -1], spec.accel_walk * walk[1, -1]])
        squares.append([d[:n] @ np.linalg.solve(truth.covariance[:n, :n], d[:n]) / n for n in (9, 15)])
    for n, square in zip((9, 15), np.mean(squares, axis=0), strict=True):
        assert square == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n / 400.0))


def test_the_variance_grows_as_closed_forms_say():
    """At rest: sigma^2 T for velocity, sigma^2 T^3 / 3 for position, whatever the rate."""
    for rate in (100.0, 200.0, 400.0):
        n = int(rate) + 1
        t = np.round(np.arange(n) * 1e9 / rate).astype(np.int64)
        still = ImuSamples(t, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1)))
        spec = replace(SPEC, rate_hz=rate, gyro_noise=1e-9, gyro_walk=1e-12, accel_walk=1e-12)
        P = preintegrate(still, np.zeros(3), np.zeros(3), spec).covariance
        assert P[6, 6] == pytest.approx(spec.accel_noise**2, rel=1e-6)
        assert P[3, 3] == pytest.approx(spec.accel_noise**2 / 3.0, rel=1e-3)
        walk = preintegrate(still, np.zeros(3), np.zeros(3), SPEC).covariance
        assert walk[9, 9] == pytest.approx(SPEC.gyro_walk**2, rel=1e-6)


def test_missing_samples_widen_the_covariance_to_what_they_cost():
    """A hole in a walk: the error stays within what the covariance says, which is far more than noise."""
    squares, growth = [], []
    for seed in range(6):
        made = scene(seed, gait="hand", duration_s=12.0)
        for start in made.frame_ns[40:200:20]:
            whole = made.samples.between(int(start), int(start) + 1_000_000_000)
            t = (whole.t_ns - start) * 1e-9
            kept = (t < 0.4) | (t > 0.55)
            holed = ImuSamples(whole.t_ns[kept], whole.gyro[kept], whole.accel[kept])
            bias = made.truth(int(start))
            full, gap = (preintegrate(s, bias.bias_gyro, bias.bias_accel, made.rig.imu) for s in (whole, holed))
            d = difference(parts(full), parts(gap))
            squares.append(d @ np.linalg.solve(gap.covariance[:9, :9], d) / 9.0)
            growth.append(gap.covariance[6, 6] / full.covariance[6, 6])
    assert np.mean(squares) < 1.0
    assert np.min(growth) > 3.0


def test_between_interpolates_both_ends_and_holds_what_is_just_beyond():
    t = np.array([0, 5_000_000, 10_000_000, 15_000_000], np.int64)
    line = np.column_stack([t * 1e-9, t * 2e-9, t * -1e-9])
    cut = ImuSamples(t, line, 3.0 * line).between(2_000_000, 20_000_000)
    assert cut.t_ns.tolist() == [2_000_000, 5_000_000, 10_000_000, 15_000_000, 20_000_000]
    np.testing.assert_allclose(cut.gyro[0], [0.002, 0.004, -0.002])
    np.testing.assert_allclose(cut.accel[-1], 3.0 * line[-1])


@pytest.mark.parametrize(
    ("start", "end", "says"),
    [(0, 0, "no time passes"), (0, 200_000_000, "must cover"), (-100_000_000, 10, "must cover")],
)
def test_what_the_stream_does_not_cover_is_refused(start, end, says):
    samples = ImuSamples(np.array([0, 5_000_000], np.int64), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(SourceError, match=says):
        samples.between(start, end)


def test_disordered_stamps_are_refused():
    samples = ImuSamples(np.array([0, 5, 5, 10], np.int64), np.zeros((4, 3)), np.zeros((4, 3)))
    with pytest.raises(SourceError, match="must rise"):
        samples.between(0, 10)


def test_preintegration_agrees_with_gtsam():
    """GTSAM steps by Euler: given the mean of neighbouring samples it is the midpoint rule to second order in dt."""
    gtsam = pytest.importorskip("gtsam", reason="needs GTSAM 4.3: pip install lodelight[reference]")
    made = scene(4, gait="drone", duration_s=6.0)
    start = int(made.frame_ns[60])
    samples = made.samples.between(start, start + 500_000_000)
    spec = replace(SPEC, gyro_walk=1e-4)
    bias = np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.05, 0.08])
    ours = preintegrate(samples, *bias, spec)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    params.setAccelerometerCovariance(np.eye(3) * spec.accel_noise**2)
    params.setGyroscopeCovariance(np.eye(3) * spec.gyro_noise**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-14)
    params.setBiasAccCovariance(np.eye(3) * spec.accel_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * spec.gyro_walk**2)
    theirs = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[1], bias[0]))
    dt = np.diff(samples.t_ns) * 1e-9
    for k, step in enumerate(dt):
        # the mean acceleration is in the axes of the middle of the step, GTSAM takes it in those of its start
        half = SE3.exp(
            np.concatenate([0.25 * step * (samples.gyro[k] + samples.gyro[k + 1] - 2 * bias[0]), np.zeros(3)])
        )
        mean = 0.5 * (samples.accel[k] + samples.accel[k + 1]) - bias[1]
        theirs.integrateMeasurement(half.R @ mean + bias[1], 0.5 * (samples.gyro[k] + samples.gyro[k + 1]), step)
    np.testing.assert_allclose(theirs.deltaRij().matrix(), ours.dR, atol=1e-8)
    np.testing.assert_allclose(theirs.deltaPij(), ours.dp, atol=2e-6)
    np.testing.assert_allclose(theirs.deltaVij(), ours.dv, atol=2e-5)
    # order of theirs: rotation, position, velocity, accelerometer bias, gyro bias; position in the axes of the end
    order = np.r_[0:9, 12:15, 9:12]
    covariance = theirs.preintMeasCov()[np.ix_(order, order)]
    # theirs is of the motion and the bias that both grow; in the residual a bias that grew leaves less of the motion
    covariance[:9, 9:] *= -1.0
    covariance[9:, :9] *= -1.0
    scale = np.sqrt(np.diag(ours.covariance))
    np.testing.assert_allclose(covariance / np.outer(scale, scale), ours.covariance / np.outer(scale, scale), atol=0.03)
    assert np.allclose(GRAVITY, [0.0, 0.0, -9.81])
