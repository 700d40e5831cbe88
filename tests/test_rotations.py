"""Rotations and rigid motions: the axioms of their groups, also near 0 and near pi."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import (
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
    right_jacobian,
    right_jacobian_inverse,
    rotation_angle,
    skew,
    so3_exp,
    so3_log,
)

# Rounding of a 3x3 product is some 1e-16; near pi the axis comes from a square root of differences.
TIGHT = 1e-12

angles = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-8, 1e-6, 9e-5, 1.1e-4, np.pi / 2, np.pi - 1e-4, np.pi - 1e-8, np.pi]),
    st.floats(0.0, np.pi),
)
components = st.floats(-1.0, 1.0)
translations = st.tuples(*[st.floats(-10.0, 10.0)] * 3).map(np.array)


@st.composite
def rotation_vectors(draw):
    axis = np.array([draw(components), draw(components), draw(components)])
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])
    return draw(angles) * axis


@st.composite
def motions(draw):
    return SE3(so3_exp(draw(rotation_vectors())), draw(translations))


@given(rotation_vectors())
def test_exp_is_a_rotation_and_agrees_with_scipy(w):
    R = so3_exp(w)
    assert np.allclose(R @ R.T, np.eye(3), atol=TIGHT)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=TIGHT)
    assert np.allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=TIGHT)


@given(rotation_vectors())
def test_exp_undoes_log_at_every_angle(w):
    R = so3_exp(w)
    assert np.allclose(so3_exp(so3_log(R)), R, atol=1e-11)
    assert np.linalg.norm(so3_log(R)) <= np.pi + TIGHT


@given(rotation_vectors())
def test_log_undoes_exp_below_pi(w):
    if np.linalg.norm(w) < np.pi - 1e-6:  # at pi the axis and its opposite are the same rotation
        assert np.allclose(so3_log(so3_exp(w)), w, atol=1e-9)


@given(rotation_vectors())
def test_exp_of_the_opposite_is_the_transpose(w):
    assert np.allclose(so3_exp(-w), so3_exp(w).T, atol=TIGHT)


@given(rotation_vectors())
def test_quaternion_and_matrix_are_one_rotation(w):
    R = so3_exp(w)
    q = quat_wxyz_from_matrix(R)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=TIGHT)
    assert q[0] >= 0.0
    assert np.allclose(matrix_from_quat_wxyz(q), R, atol=1e-11)
    assert np.allclose(matrix_from_quat_wxyz(3.0 * q), R, atol=1e-11)


@given(rotation_vectors())
def test_rotation_angle_keeps_its_digits_near_zero_and_pi(w):
    assert rotation_angle(so3_exp(w)) == pytest.approx(np.linalg.norm(w), abs=1e-9)


@given(rotation_vectors(), rotation_vectors())
def test_skew_is_the_cross_product(a, b):
    assert np.allclose(skew(a) @ b, np.cross(a, b), atol=TIGHT)


@given(rotation_vectors())
def test_right_jacobian_matches_central_differences(w):
    step = 1e-6
    numeric = np.column_stack(
        [(so3_log(so3_exp(w).T @ so3_exp(w + d)) - so3_log(so3_exp(w).T @ so3_exp(w - d))) for d in step * np.eye(3)]
    ) / (2 * step)
    assert np.allclose(right_jacobian(w), numeric, atol=1e-8)  # differences of 1e-6 lose ten digits of sixteen


@given(rotation_vectors())
def test_right_jacobian_inverse_is_the_inverse(w):
    # the angle 2 pi, where J_r is singular, is outside [0, pi]
    assert np.allclose(right_jacobian_inverse(w) @ right_jacobian(w), np.eye(3), atol=1e-9)


@given(motions(), motions(), motions())
def test_motions_are_a_group(A, B, C):
    assert np.allclose(((A @ B) @ C).matrix, (A @ (B @ C)).matrix, atol=1e-10)
    assert np.allclose((A @ A.inverse()).matrix, np.eye(4), atol=1e-11)
    assert np.allclose((A @ SE3.identity()).matrix, A.matrix, atol=0.0)
    assert np.allclose((A @ B).matrix, A.matrix @ B.matrix, atol=1e-11)


@given(motions(), translations)
def test_points_move_as_by_the_matrix(T, p):
    assert np.allclose(T @ p, (T.matrix @ np.append(p, 1.0))[:3], atol=1e-11)
    assert np.allclose(T @ np.stack([p, 2 * p]), [T @ p, T @ (2 * p)], atol=1e-11)


@given(motions())
def test_a_motion_survives_its_log_its_quaternion_and_its_matrix(T):
    for other in (SE3.exp(T.log()), SE3.from_quat_xyzw(T.t, T.quat_xyzw), SE3.from_matrix(T.matrix)):
        assert np.allclose(other.matrix, T.matrix, atol=1e-10)


@given(motions())
def test_a_perturbation_is_on_the_right_in_rotation_and_plain_in_position(T):
    d = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    moved = T.perturbed(d)
    assert np.allclose(moved.R, T.R @ so3_exp(d[:3]), atol=TIGHT)
    assert np.allclose(moved.t, T.t + d[3:], atol=TIGHT)


@given(motions(), motions())
def test_interpolation_meets_both_ends_and_halves_the_turn(A, B):
    assert np.allclose(A.interpolate(B, 0.0).matrix, A.matrix, atol=1e-11)
    assert np.allclose(A.interpolate(B, 1.0).matrix, B.matrix, atol=1e-9)
    half = A.interpolate(B, 0.5)
    assert (A.inverse() @ half).angle == pytest.approx((half.inverse() @ B).angle, abs=1e-7)


def test_from_matrix_projects_a_noisy_rotation_onto_the_nearest_one():
    R = so3_exp(np.array([0.3, -0.5, 1.1]))
    noisy = np.eye(4)
    noisy[:3, :3] = R + 1e-4 * np.arange(9).reshape(3, 3)
    out = SE3.from_matrix(noisy)
    assert np.allclose(out.R @ out.R.T, np.eye(3), atol=TIGHT)
    assert np.linalg.det(out.R) > 0
    assert np.allclose(out.R, R, atol=1e-3)
