"""Evaluation against evo and against closed forms."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from lodelight.cli.main import main
from lodelight.errors import ConfigError, SourceError
from lodelight.evaluation.align import align
from lodelight.evaluation.associate import associate, coverage, matched
from lodelight.evaluation.ate import ate
from lodelight.evaluation.compare import compare
from lodelight.evaluation.nees import chart_errors, nees
from lodelight.evaluation.rpe import rpe
from lodelight.geometry.se3 import SE3
from lodelight.io.covariances import read_covariances, write_covariances
from lodelight.io.trajectories import write_tum
from lodelight.trajectory import Trajectory

SIX_DIGITS = 1e-6


def path_of(t_s, seed=0):
    """A smooth hand-held path sampled at stamps (N,) s."""
    rng = np.random.default_rng(seed)
    w, phase = rng.uniform(0.3, 1.5, (6, 3)), rng.uniform(0, 6, (6, 3))
    waves = np.sin(t_s[:, None, None] * w + phase)
    xyz = waves[:, :3].sum(axis=1)
    quat = Rotation.from_rotvec(0.6 * waves[:, 3:].sum(axis=1)).as_quat()
    return Trajectory(np.round(t_s * 1e9).astype(np.int64) + 1_700_000_000_000_000_000, xyz, quat)


def disturbed(path, seed, noise_m=0.02, noise_rad=0.01, scale=1.0, yaw_only=False):
    """The path in another world frame, with noise on every pose."""
    rng = np.random.default_rng(seed)
    G = Rotation.from_euler("z", 2.0) if yaw_only else Rotation.from_rotvec([0.4, -1.2, 2.0])
    xyz = scale * G.apply(path.xyz) + [3.0, -2.0, 0.5] + rng.normal(0, noise_m, path.xyz.shape)
    turned = G * Rotation.from_quat(path.quat_xyzw) * Rotation.from_rotvec(rng.normal(0, noise_rad, path.xyz.shape))
    return Trajectory(path.t_ns, xyz, turned.as_quat())


def evo_path(path):
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(path.xyz, np.roll(path.quat_xyzw, 1, axis=1), path.t_ns / 1e9)


def evo_ape(estimate, truth, relation):
    from evo.core import metrics

    ape = metrics.APE(metrics.PoseRelation[relation])
    ape.process_data((truth, estimate))
    return ape.get_all_statistics() | {"p95": float(np.percentile(ape.error, 95))}


@pytest.mark.parametrize("mode", ["se3", "sim3", "none"])
@pytest.mark.parametrize(("rate_hz", "truth_hz"), [(30.0, 100.0), (20.0, 20.0), (15.0, 200.0), (60.0, 20.0)])
def test_ate_agrees_with_evo(mode, rate_hz, truth_hz):
    from evo.core import sync

    seed = round(rate_hz + truth_hz)
    rng = np.random.default_rng(seed)
    stamps = np.arange(0, 20, 1 / rate_hz) + 0.0031
    stamps = stamps[(stamps < 7) | (stamps > 9)]  # lost for two seconds
    stamps = stamps[rng.random(len(stamps)) > 0.1]
    truth = path_of(np.arange(0, 20, 1 / truth_hz))
    estimate = disturbed(path_of(stamps), seed, scale=0.7 if mode == "sim3" else 1.0)
    # Below half the coarser spacing every pose has one partner, and evo's rule and ours say the same.
    max_dt_s = 0.4 / max(rate_hz, truth_hz)

    ours, true = matched(estimate, truth, max_dt_s)
    evo_true, evo_ours = sync.associate_trajectories(evo_path(truth), evo_path(estimate), max_diff=max_dt_s)
    assert len(ours) == evo_ours.num_poses
    if mode != "none":
        evo_ours.align(evo_true, correct_scale=mode == "sim3")
    result = ate(ours, true, mode)
    position = evo_ape(evo_ours, evo_true, "translation_part")
    assert result.rmse_m == pytest.approx(position["rmse"], rel=SIX_DIGITS)
    assert result.mean_m == pytest.approx(position["mean"], rel=SIX_DIGITS)
    assert result.median_m == pytest.approx(position["median"], rel=SIX_DIGITS)
    assert result.max_m == pytest.approx(position["max"], rel=SIX_DIGITS)
    assert result.p95_m == pytest.approx(position["p95"], rel=SIX_DIGITS)
    angle = evo_ape(evo_ours, evo_true, "rotation_angle_deg")
    assert result.rotation_deg == pytest.approx(angle["rmse"], rel=SIX_DIGITS)


@pytest.mark.parametrize(("delta", "unit"), [(1.0, "m"), (0.5, "m"), (1.0, "s"), (2.0, "s")])
def test_rpe_agrees_with_evo(delta, unit):
    from evo.core import metrics

    # At 4 Hz no neighbour of the pose one second on is within a tenth of it, as evo's count of frames has it.
    spacing_s = 0.05 if unit == "m" else 0.25
    truth = path_of(np.arange(0, 20, spacing_s), seed=3)
    estimate = disturbed(truth, 4)
    result = rpe(estimate, truth, delta, unit)
    for relation, ours in (("translation_part", result.translation_m), ("rotation_angle_deg", result.rotation_deg)):
        theirs = metrics.RPE(
            metrics.PoseRelation[relation],
            delta=delta if unit == "m" else round(delta / spacing_s),
            delta_unit=metrics.Unit.meters if unit == "m" else metrics.Unit.frames,
            rel_delta_tol=0.1,
            all_pairs=True,
            pairs_from_reference=True,
        )
        theirs.process_data((evo_path(truth), evo_path(estimate)))
        assert result.pairs == len(theirs.error)
        assert ours == pytest.approx(theirs.get_all_statistics()["rmse"], rel=SIX_DIGITS)


def test_rpe_is_the_same_in_every_world_frame_and_blind_across_gaps():
    t_s = np.concatenate([np.arange(0, 3, 0.1), np.arange(6, 9, 0.1)])
    truth = path_of(t_s)
    moved = disturbed(truth, 1, noise_m=0.0, noise_rad=0.0)
    result = rpe(moved, truth, 1.0, "s")
    # 30 poses on either side of the gap, of which the last ten (and 0.9 s counts as 1 s) have no end
    assert 2 * 20 <= result.pairs <= 2 * 21
    assert result.translation_m < 1e-12
    assert rpe(moved, truth, 4.0, "s").pairs > 0  # from one side to the other
    assert rpe(moved, truth, 100.0, "s").translation_m is None


def test_yaw_alignment_is_the_best_rotation_about_z():
    truth = path_of(np.arange(0, 10, 0.1), seed=5)
    estimate = disturbed(truth, 6, noise_m=0.1, yaw_only=True)
    found = align(estimate, truth, "yaw")

    def cost(yaw):
        turned = Rotation.from_euler("z", yaw).apply(estimate.xyz - estimate.xyz.mean(axis=0))
        return ((turned - truth.xyz + truth.xyz.mean(axis=0)) ** 2).sum()

    best = min((minimize_scalar(cost, bounds=(a, a + 1), method="bounded") for a in range(-4, 4)), key=lambda r: r.fun)
    moved = found.apply(estimate).xyz - truth.xyz
    assert (moved**2).sum() == pytest.approx(best.fun, rel=1e-9)
    np.testing.assert_allclose(found.R[:, 2], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(moved.mean(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
def test_a_path_in_another_frame_is_brought_back(mode):
    truth = path_of(np.arange(0, 10, 0.1))
    scale = 0.4 if mode == "sim3" else 1.0
    estimate = disturbed(truth, 0, 0.0, 0.0, scale=scale, yaw_only=mode == "yaw")
    result = ate(estimate, truth, mode)
    assert result.max_m < 1e-9
    assert result.rotation_deg < 1e-5  # an angle near 0 from products of quaternions
    assert result.scale == pytest.approx(1 / scale)
    found = align(estimate, truth, mode)
    back = found.inverse().apply(found.apply(estimate))
    np.testing.assert_allclose(back.xyz, estimate.xyz, atol=1e-12)


@pytest.mark.parametrize("direction", [[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])
@pytest.mark.parametrize("mode", ["se3", "yaw"])
def test_standing_still_or_driving_straight_is_aligned_by_the_orientations(direction, mode):
    n = 50
    xyz = np.linspace(0, 1, n)[:, None] * np.array(direction)
    quat = Rotation.from_rotvec(np.outer(np.linspace(0, 0.4, n), [0, 0, 1])).as_quat()
    truth = Trajectory(np.arange(n) * 10**8, xyz, quat)
    estimate = disturbed(truth, 0, 0.0, 0.0, yaw_only=mode == "yaw")
    result = ate(estimate, truth, mode)
    assert result.max_m < 1e-6
    assert result.rotation_deg < 1e-3


def test_the_scale_of_no_motion_is_refused():
    n = 10
    still = Trajectory(np.arange(n), np.zeros((n, 3)), np.tile([0.0, 0, 0, 1], (n, 1)))
    with pytest.raises(SourceError, match="does not move"):
        align(still, still, "sim3")
    with pytest.raises(ConfigError, match="--align"):
        align(still, still, "affine")


stamps = st.lists(st.integers(0, 2000), min_size=0, max_size=60, unique=True).map(
    lambda values: np.array(sorted(values), dtype=np.int64)
)


@given(stamps, stamps, st.integers(0, 300))
@settings(max_examples=200, deadline=None)
def test_association_is_unique_mutual_and_within_the_limit(a, b, limit):
    i, j = associate(a, b, limit / 1e9)
    assert len(set(i)) == len(i) == len(set(j)) == len(j)
    for row_a, row_b in zip(i, j, strict=True):
        dt = abs(a[row_a] - b[row_b])
        assert dt <= limit
        assert dt == np.abs(a - b[row_b]).min() == np.abs(b - a[row_a]).min()
    # whoever has no partner is out of reach, or its nearest is nearer to another
    for row_a in set(range(len(a))) - set(i):
        if len(b):
            near = np.abs(b - a[row_a])
            assert near.min() > limit or np.abs(a - b[near.argmin()]).min() <= near.min()


def test_coverage_counts_holes_and_not_a_slow_rate():
    truth = np.arange(0, 10_000_000_000, 10_000_000)  # 100 Hz
    slow = np.arange(0, 10_000_000_000, 200_000_000)  # 5 Hz
    assert coverage(slow, truth) == 1.0
    hole = slow[(slow < 4e9) | (slow > 7e9)]
    # no estimate from 3.8 to 7.2 s, of which 0.2 s at either rim are within one spacing
    assert coverage(hole, truth) == pytest.approx(0.7, abs=0.002)
    assert coverage(slow[:0], truth) == 0.0


def test_nees_is_one_when_the_covariance_is_that_of_the_noise():
    rng = np.random.default_rng(7)
    truth = path_of(np.arange(0, 200, 0.1))
    A = rng.normal(size=(len(truth), 6, 6)) * np.array([0.01, 0.01, 0.01, 0.02, 0.05, 0.01])[:, None]
    covariance = A @ A.transpose(0, 2, 1)
    d = np.einsum("nij,nj->ni", A, rng.normal(size=(len(truth), 6)))
    # truth = estimate.perturbed(d): the chart of SE3.perturbed, pose by pose
    poses = [SE3(T.R @ SE3.exp(-e).R, T.t - e[3:]) for T, e in zip(map(truth.pose, range(len(truth))), d, strict=True)]
    estimate = Trajectory.from_poses(truth.t_ns.tolist(), poses)
    np.testing.assert_allclose(chart_errors(estimate, truth), d, atol=1e-9)
    result = nees(estimate, truth, covariance)
    # mean of 2000 chi-square(6)/6: sigma 0.013
    assert result.pose == pytest.approx(1.0, abs=0.05)
    assert result.within_95 == pytest.approx(0.95, abs=0.02)
    assert nees(estimate, truth, 4 * covariance).position == pytest.approx(result.position / 4)
    covariance[:5] = 0.0
    covariance[5] = np.nan
    assert nees(estimate, truth, covariance).poses == len(truth) - 6
    assert nees(estimate, truth, 0 * covariance[:1]) is None


def test_nees_does_not_depend_on_the_worlds_of_truth_and_estimate():
    truth = path_of(np.arange(0, 20, 0.1), seed=1)
    estimate = disturbed(truth, 2)
    covariance = np.tile(np.diag([1e-4, 1e-4, 1e-4, 9e-4, 1e-4, 4e-4]), (len(truth), 1, 1))
    known = (estimate.t_ns, covariance)
    elsewhere = disturbed(truth, 0, 0.0, 0.0)
    here, there = compare(estimate, truth, covariances=known).nees, compare(estimate, elsewhere, covariances=known).nees
    assert here.pose == pytest.approx(there.pose, rel=1e-9)


def test_covariances_come_back_as_written(tmp_path):
    rng = np.random.default_rng(0)
    A = rng.normal(size=(4, 6, 6))
    C = A @ A.transpose(0, 2, 1)
    write_covariances(tmp_path / "covariance.csv", [1, 2, 3, 1_700_000_000_000_000_000], list(C))
    t_ns, back = read_covariances(tmp_path / "covariance.csv")
    np.testing.assert_array_equal(t_ns, [1, 2, 3, 1_700_000_000_000_000_000])
    np.testing.assert_array_equal(np.triu(back), np.triu(C))
    np.testing.assert_array_equal(back, back.transpose(0, 2, 1))


def test_eval_prints_the_figures_and_says_what_does_not_match(tmp_path, capsys):
    truth = path_of(np.arange(0, 10, 0.05))
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "estimate.tum", disturbed(truth, 0))
    files = [str(tmp_path / "estimate.tum"), str(tmp_path / "truth.tum")]
    assert main(["eval", *files, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["ate"]["rmse_m"] == pytest.approx(ate(disturbed(truth, 0), truth).rmse_m, rel=1e-6)
    assert printed["coverage"] == 1.0
    assert main(["eval", *files, "--align", "none"]) == 0
    assert "ATE" in capsys.readouterr().out

    late = Trajectory(truth.t_ns + 10**12, truth.xyz, truth.quat_xyzw)
    write_tum(tmp_path / "estimate.tum", late)
    assert main(["eval", *files]) == 2
    assert "--max-dt" in capsys.readouterr().err
