"""The solvers under the estimators against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from lodelight.estimation.block_cholesky import BlockPlan
from lodelight.geometry.dense import cholesky, cholesky_solve, inverse3, matmul, spd_inverse, transposed


def coupled_blocks(rng, n, density):
    """A symmetric positive definite matrix of 6x6 blocks, and which of them are not zero."""
    coupled = np.triu(rng.random((n, n)) < density, 1)
    coupled |= coupled.T
    A = rng.normal(size=(6 * n, 6 * n)) * np.kron(coupled, np.ones((6, 6)))
    A = A + A.T
    return A + np.diag(np.abs(A).sum(axis=1) + rng.uniform(0.1, 1.0, 6 * n)), coupled


def filled(plan, A):
    """The blocks of A where the plan wants them: by position, upper half."""
    n = len(plan.position)
    node = np.argsort(plan.position)
    S = np.zeros((plan.n_blocks, 6, 6))
    for i in range(n):
        for j in range(i, n):
            if plan.slot[i, j] >= 0:
                S[plan.slot[i, j]] = A[6 * node[i] : 6 * node[i] + 6, 6 * node[j] : 6 * node[j] + 6]
    return S


@pytest.mark.parametrize(("n", "density"), [(0, 0.0), (1, 0.0), (12, 0.0), (30, 0.05), (30, 0.3), (20, 1.0)])
def test_block_cholesky_solves_what_numpy_solves(n, density):
    rng = np.random.default_rng(n)
    A, coupled = coupled_blocks(rng, n, density)
    plan = BlockPlan.of(coupled)
    S, b = filled(plan, A), rng.normal(size=(n, 6))
    x = b[np.argsort(plan.position)].copy()
    assert plan.factor(S)
    plan.solve(S, x)
    np.testing.assert_allclose(x[plan.position].ravel(), np.linalg.solve(A, b.ravel()), atol=1e-12)


def test_elimination_order_keeps_an_arrow_sparse():
    """One node coupled to all: eliminated first it would fill the matrix, last it fills nothing."""
    coupled = np.zeros((50, 50), bool)
    coupled[0, :] = coupled[:, 0] = True
    assert BlockPlan.of(coupled).n_blocks == 50 + 49


def test_block_cholesky_refuses_what_is_not_definite():
    rng = np.random.default_rng(1)
    A, coupled = coupled_blocks(rng, 10, 0.3)
    plan = BlockPlan.of(coupled)
    assert not plan.factor(filled(plan, A - 2.0 * np.linalg.eigvalsh(A)[0] * np.eye(60)))


def test_small_matrices_match_numpy():
    rng = np.random.default_rng(2)
    for n in (1, 3, 6, 15):
        A, B = rng.normal(size=(n, n)), rng.normal(size=(n, 4))
        np.testing.assert_allclose(matmul(A, B), A @ B, atol=1e-13)
        assert np.array_equal(transposed(B), B.T)
        spd = A @ A.T + np.eye(n)
        inverse, definite = spd_inverse(spd)
        assert definite
        assert np.array_equal(inverse, inverse.T)
        np.testing.assert_allclose(inverse, np.linalg.inv(spd), atol=1e-11)
        L, x = spd.copy(), B[:, 0].copy()
        assert cholesky(L)
        cholesky_solve(L, x)
        np.testing.assert_allclose(x, np.linalg.solve(spd, B[:, 0]), atol=1e-11)
        assert not spd_inverse(-spd)[1]


@pytest.mark.parametrize("ratio", [1.0, 1e-4, 1e-8, 1e-11])
def test_inverse_of_three_keeps_its_digits_where_one_direction_is_weak(ratio):
    """Backward stable: relative error up to rounding times the condition, as of any solver."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        A = Q @ np.diag([1.0, 0.5, ratio]) @ Q.T
        v = inverse3(A[0, 0], A[1, 0], A[1, 1], A[2, 0], A[2, 1], A[2, 2])
        inverse = np.array([[v[0], v[1], v[3]], [v[1], v[2], v[4]], [v[3], v[4], v[5]]])
        np.testing.assert_allclose(
            inverse * ratio, Q @ np.diag([ratio, 2 * ratio, 1.0]) @ Q.T, atol=1e-14 / ratio + 1e-14
        )
    assert inverse3(1.0, 2.0, 1.0, 0.0, 0.0, 1.0) == (0.0,) * 6
    assert inverse3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) == (0.0,) * 6
