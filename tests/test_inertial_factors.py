"""The factors of the window: zero at the truth, Jacobians against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from estimator_scenes import LENSES, random_pose
from lodelight.estimation.factors.inertial import inertial_jacobian, inertial_residual
from lodelight.estimation.factors.inverse_depth import inverse_depth_jacobian, inverse_depth_residual
from lodelight.estimation.factors.tag_corners import tag_corner_jacobian, tag_corner_residual
from lodelight.estimation.window_frames import Seen, WindowFrame, row_of
from lodelight.estimation.window_types import Observations
from lodelight.geometry.se3 import SE3
from lodelight.imu.preintegration import NavState, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec

STEP = 1e-6


def moved(row, d):
    """A state's row perturbed in its chart (theta, p, v, bg, ba)."""
    T = SE3(row[:9].reshape(3, 3), row[9:12]).perturbed(d[:6])
    return np.concatenate([T.R.ravel(), T.t, row[12:] + d[6:]])


def differences(function, n, step=STEP):
    """Central differences of function(d (n,)) at zero, by columns."""
    return np.column_stack([(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(n)])


def shaken(rng, n=41, dt_s=0.005):
    t = np.arange(n) * round(dt_s * 1e9)
    return ImuSamples(t.astype(np.int64), rng.normal(size=(n, 3)) * 0.8, rng.normal(size=(n, 3)) * 2.0 + [0, 0, 9.8])


def measured(rng):
    """A measurement's row, and the state it starts from."""
    imu = preintegrate(shaken(rng), rng.normal(size=3) * 0.02, rng.normal(size=3) * 0.1, ImuSpec())
    state = NavState(0, random_pose(rng), rng.normal(size=3), imu.bias_gyro, imu.bias_accel)
    frame = WindowFrame(0, 0, np.zeros(21), True, Seen.of(Observations.none(), ()), [])
    frame.carry(imu)
    return frame, imu, state


def test_the_imu_residual_is_zero_where_the_state_is_what_the_imu_predicts():
    frame, imu, state = measured(np.random.default_rng(0))
    r = np.empty(15)
    inertial_residual(row_of(state), row_of(state.predicted(imu)), frame.measured, r)
    assert np.abs(r).max() < 1e-12


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_imu_jacobians_match_central_differences(off):
    """Also where the residual is not zero and the biases are not those integrated with."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        frame, imu, state = measured(rng)
        xi = moved(row_of(state), off * rng.normal(size=15))
        xj = moved(row_of(state.predicted(imu)), off * rng.normal(size=15))

        def residual(d, xi=xi, xj=xj, frame=frame):
            r = np.empty(15)
            inertial_residual(moved(xi, d[:15]), moved(xj, d[15:]), frame.measured, r)
            return r

        J = np.empty((15, 30))
        inertial_jacobian(xi, xj, frame.measured, residual(np.zeros(30)), J)
        np.testing.assert_allclose(J, differences(residual, 30), atol=2e-7)


def test_the_whitening_is_the_inverse_root_of_the_covariance():
    frame, imu, _ = measured(np.random.default_rng(2))
    np.testing.assert_allclose(frame.whiten @ imu.covariance @ frame.whiten.T, np.eye(15), atol=1e-9)


def sighting(rng, lens, same_frame=False):
    """Poses, mountings, base and a landmark that camera j sees, with its pixel and 1/z there."""
    camera = LENSES[lens]
    while True:
        T_i, T_ci, T_cj = (random_pose(rng) for _ in range(3))
        T_cj = T_ci.perturbed(rng.normal(size=6) * 0.05)
        T_j = T_i if same_frame else T_i.perturbed(rng.normal(size=6) * 0.15)
        n = rng.normal(size=3) * [0.3, 0.3, 0.0] + [0.0, 0.0, 1.0]
        base = np.linalg.qr(np.column_stack([n, rng.normal(size=(3, 2))]))[0][:, [1, 2, 0]]
        base *= np.sign(base[2, 2])
        landmark = np.array([0.02, -0.01, rng.uniform(0.1, 0.6)])
        direction = base @ np.array([landmark[0], landmark[1], 1.0])
        X = (T_j @ T_cj).inverse() @ (T_i @ T_ci) @ (direction / landmark[2])
        px, seen = camera.project(X[None])
        if seen[0] and X[2] > 0.3:
            return camera, T_i, T_ci, T_j, T_cj, np.ascontiguousarray(base), landmark, px[0], 1.0 / X[2]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("depth", [False, True])
def test_inverse_depth_jacobians_match_central_differences(lens, depth):
    rng = np.random.default_rng(3)
    for _ in range(5):
        camera, T_i, T_ci, T_j, T_cj, base, landmark, px, rho = sighting(rng, lens)
        inv_depth, sigma = (rho if depth else 0.0), (0.8, 0.02)

        def residual(d, off=0.0, view=(camera, T_i, T_ci, T_j, T_cj, base, landmark, px), inv_depth=inv_depth):
            camera, T_i, T_ci, T_j, T_cj, base, landmark, px = view
            a, j, ca, cj = (T.perturbed(e) for T, e in ((T_i, d[:6]), (T_j, d[6:12]), (T_ci, d[15:21]), (T_cj, d[21:])))
            r = np.empty(3)
            rows = inverse_depth_residual(
                camera.model, camera.params, a.R, a.t, ca.R, ca.t, j.R, j.t, cj.R, cj.t, base, landmark + d[12:15],
                px[0] + off, px[1] - off, 0.8, inv_depth, 0.02, r,
            )  # fmt: skip
            assert rows == (3 if inv_depth > 0.0 else 2)
            return r

        assert np.abs(residual(np.zeros(27))).max() < 1e-9
        J, E = np.empty((3, 27)), np.empty((2, 3))
        assert inverse_depth_jacobian(
            camera.model, camera.params, T_i.R, T_i.t, T_ci.R, T_ci.t, T_j.R, T_j.t, T_cj.R, T_cj.t, base, landmark,
            sigma[0], inv_depth, sigma[1], E, J,
        )  # fmt: skip
        numeric = differences(lambda d: residual(d, 2.0), 27)
        np.testing.assert_allclose(J, numeric, rtol=1e-5, atol=2e-4)


def test_in_one_frame_both_cameras_leave_the_pose_alone():
    camera, T_i, T_ci, T_j, T_cj, base, landmark, _, rho = sighting(np.random.default_rng(4), "radtan", same_frame=True)
    J, E = np.empty((3, 27)), np.empty((2, 3))
    inverse_depth_jacobian(
        camera.model, camera.params, T_i.R, T_i.t, T_ci.R, T_ci.t, T_j.R, T_j.t, T_cj.R, T_cj.t, base, landmark,
        1.0, rho, 0.02, E, J,
    )  # fmt: skip
    np.testing.assert_allclose(J[:, :6] + J[:, 6:12], 0.0, atol=1e-9)


def test_a_point_at_infinity_is_seen_and_says_nothing_of_position():
    camera, T_i, T_ci, T_j, T_cj, base, landmark, px, _ = sighting(np.random.default_rng(5), "radtan")
    landmark[2] = 0.0
    r, J, E = np.empty(3), np.empty((3, 27)), np.empty((2, 3))
    where = (T_i.R, T_i.t, T_ci.R, T_ci.t, T_j.R, T_j.t, T_cj.R, T_cj.t, base, landmark)
    assert inverse_depth_residual(camera.model, camera.params, *where, px[0], px[1], 1.0, 0.0, 1.0, r) == 2
    assert inverse_depth_jacobian(camera.model, camera.params, *where, 1.0, 0.0, 1.0, E, J)
    assert np.abs(J[:, 3:6]).max() == 0.0
    assert np.abs(J[:2, 14]).max() > 1.0  # its depth shows all the same


def test_what_the_camera_cannot_see_has_no_residual():
    camera, T_i, T_ci, T_j, T_cj, base, landmark, px, _ = sighting(np.random.default_rng(6), "radtan")
    behind = np.ascontiguousarray(base * [1.0, -1.0, -1.0])
    r = np.empty(3)
    for b, u in ((behind, px[0]), (base, np.nan)):
        where = (T_i.R, T_i.t, T_ci.R, T_ci.t, T_j.R, T_j.t, T_cj.R, T_cj.t, b, landmark)
        assert inverse_depth_residual(camera.model, camera.params, *where, u, px[1], 1.0, 0.0, 1.0, r) == 0


@pytest.mark.parametrize("lens", LENSES)
def test_tag_corner_jacobians_match_central_differences(lens):
    rng = np.random.default_rng(7)
    camera = LENSES[lens]
    for _ in range(5):
        T, T_c = random_pose(rng), random_pose(rng)
        T_t = T @ T_c @ SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.1, -0.1, 1.5])).perturbed(rng.normal(size=6) * 0.1)
        s = np.array([0.1, -0.1, 0.0])
        px, seen = camera.project(((T @ T_c).inverse() @ T_t @ s)[None])
        assert seen[0]

        def residual(d, off=0.0, view=(T, T_c, T_t, px[0], s)):
            T, T_c, T_t, px, s = view
            a, t, c = T.perturbed(d[:6]), T_t.perturbed(d[6:12]), T_c.perturbed(d[12:])
            r = np.empty(2)
            assert tag_corner_residual(
                camera.model,
                camera.params,
                a.R,
                a.t,
                c.R,
                c.t,
                t.R,
                t.t,
                *s,
                px[0] + off,
                px[1] - off,
                0.4,
                r,
            )
            return r

        assert np.abs(residual(np.zeros(18))).max() < 1e-9
        J, E = np.empty((2, 18)), np.empty((2, 3))
        assert tag_corner_jacobian(camera.model, camera.params, T.R, T.t, T_c.R, T_c.t, T_t.R, T_t.t, *s, 0.4, E, J)
        np.testing.assert_allclose(J, differences(lambda d: residual(d, 2.0), 18), rtol=1e-5, atol=2e-4)
