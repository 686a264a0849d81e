from typing import Any

import numpy as np
import pytest
from filterpy.common import (
    Q_continuous_white_noise,
    Q_discrete_white_noise,
    van_loan_discretization,
)
from scipy.linalg import expm

from estbench.errors import CovarianceError, DimensionError
from estbench.models.noise import scheduled, van_loan, white_acceleration, white_jerk
from tests.helpers import random_cov


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "k"), [(1, 1), (3, 2), (4, 4)])
def test_van_loan_is_the_integral(seed, n, k):
    rng = np.random.default_rng(seed)
    F, G, Q_s = rng.standard_normal((n, n)), rng.standard_normal((n, k)), random_cov(rng, k)

    nodes, weights = np.polynomial.legendre.leggauss(30)
    responses = expm(F * (0.35 * (nodes + 1.0))[:, None, None]) @ G
    integral = np.einsum("p,pij,jk,plk->il", 0.35 * weights, responses, Q_s, responses)
    Phi, Q = van_loan(F, Q_s, 0.7, G)
    np.testing.assert_allclose(Phi, expm(F * 0.7), atol=1e-12)
    np.testing.assert_allclose(Q, integral, atol=1e-10)
    np.testing.assert_array_equal(Q, Q.T)


def test_van_loan_of_a_stack_is_each_of_its_matrices():
    rng = np.random.default_rng(0)
    F, Q_s = rng.standard_normal((3, 2, 2)), random_cov(rng, 2)
    Phi, Q = van_loan(F, Q_s, 0.1)
    for run in range(3):
        one_Phi, one_Q = van_loan(F[run], Q_s, 0.1)
        np.testing.assert_allclose(Phi[run], one_Phi, atol=1e-14)
        np.testing.assert_allclose(Q[run], one_Q, atol=1e-14)


def test_van_loan_equals_filterpy():
    F, G = np.array([[0.0, 1.0], [-1.0, -0.2]]), np.array([[0.0], [2.0]])
    Phi, Q = van_loan(F, np.eye(1), 0.1, G)
    expected_Phi, expected_Q = van_loan_discretization(F, G, 0.1)
    np.testing.assert_allclose(Phi, expected_Phi, atol=1e-12)
    np.testing.assert_allclose(Q, expected_Q, atol=1e-12)


def chain(order, axes):
    F: Any = np.kron(np.diag(np.ones(order - 1), 1), np.eye(axes))
    G: Any = np.kron(np.eye(order)[:, -1:], np.eye(axes))
    return F, G


@pytest.mark.parametrize(("builder", "order"), [(white_acceleration, 2), (white_jerk, 3)])
def test_continuous_white_noise_is_van_loans_and_filterpys(builder, order):
    q = np.array([2.0, 0.5])
    F, G = chain(order, 2)
    np.testing.assert_allclose(builder(0.3, q), van_loan(F, np.diag(q), 0.3, G)[1], atol=1e-14)
    peer: Any = Q_continuous_white_noise(order, 0.3, 2.0)
    np.testing.assert_allclose(builder(0.3, 2.0), peer)


@pytest.mark.parametrize(("builder", "order"), [(white_acceleration, 2), (white_jerk, 3)])
def test_held_noise_is_the_response_to_a_constant_draw(builder, order):
    q, dt = np.array([2.0, 0.5]), 0.3
    F, G = chain(order, 2)
    augmented = np.block([[F, G], [np.zeros((2, 2 * order + 2))]])
    response = expm(augmented * dt)[:-2, -2:]
    expected = response @ np.diag(q / dt) @ response.T
    np.testing.assert_allclose(builder(dt, q, held=True), expected, atol=1e-14)


def test_held_acceleration_equals_filterpy():
    expected: Any = Q_discrete_white_noise(2, 0.3, 4.0 / 0.3)
    np.testing.assert_allclose(white_acceleration(0.3, 4.0, held=True), expected)


@pytest.mark.parametrize("held", [False, True])
def test_velocity_variance_grows_with_time_whatever_the_step(held):
    F, _ = chain(2, 1)
    P = np.zeros((2, 2))
    for _ in range(100):
        Phi = np.eye(2) + 0.01 * F
        P = Phi @ P @ Phi.T + white_acceleration(0.01, 3.0, held)
    np.testing.assert_allclose(P[1, 1], 3.0)
    np.testing.assert_allclose(P, white_acceleration(1.0, 3.0), rtol=1e-4)


@pytest.mark.parametrize(("q", "dt"), [(-1.0, 0.1), ([1.0, -2.0], 0.1), (1.0, 0.0)])
def test_wrong_densities_are_refused(q, dt):
    with pytest.raises(CovarianceError, match="q is"):
        white_acceleration(dt, q)


def test_van_loan_names_a_wrong_density():
    with pytest.raises(DimensionError, match=r"Q_s has shape \(2, 2\); expected \(1, 1\)"):
        van_loan(np.eye(2), np.eye(2), 0.1, np.ones((2, 1)))


def test_a_schedule_holds_each_matrix_from_its_time_on():
    matrix = scheduled([0.0, 1.0, 3.0], [np.eye(2) * k for k in (1, 2, 3)])
    for t, k in ((-1.0, 1), (0.0, 1), (0.99, 1), (1.0, 2), (0.1 * 10, 2), (2.9, 2), (9.0, 3)):
        np.testing.assert_array_equal(matrix(t), np.eye(2) * k)
    for times in ([0.0, 2.0, 1.0], [0.0, 1.0]):
        with pytest.raises(DimensionError, match="increasing"):
            scheduled(times, np.zeros((3, 2, 2)))
