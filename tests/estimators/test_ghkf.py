import itertools

import numpy as np
import pytest

from estbench.errors import EstimatorError
from estbench.estimators.ckf import CKF
from estbench.estimators.ghkf import GHKF
from estbench.estimators.sigma_points import gauss_hermite
from estbench.estimators.ukf import UKF
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from tests.helpers import linear_model, nonlinear_model, random_cov


def textbook_ghkf(model, x, P, y, u, dt, order):
    """Ito & Xiong 2000: every expectation a product quadrature."""
    nodes, weights = np.polynomial.hermite.hermgauss(order)

    def expected(g, x, P):
        root = np.linalg.cholesky(P)
        total = 0.0
        for index in itertools.product(range(order), repeat=len(x)):
            weight = np.prod(weights[list(index)]) / np.pi ** (len(x) / 2)
            total = total + weight * g(x + np.sqrt(2.0) * root @ nodes[list(index)])
        return total

    f, h = (lambda p: model.f(p, u, 0.0, dt)), (lambda p: model.h(p, u, dt))
    mean = expected(f, x, P)
    P = expected(lambda p: np.outer(f(p) - mean, f(p) - mean), x, P) + model.Q
    x, z = mean, expected(h, mean, P)
    S = expected(lambda p: np.outer(h(p) - z, h(p) - z), x, P) + model.R
    K = expected(lambda p: np.outer(p - x, h(p) - z), x, P) @ np.linalg.inv(S)
    return x + K @ (y - z), P - K @ S @ K.T


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "order"), [(2, 2), (2, 3), (2, 7), (4, 3)])
def test_equals_the_textbook(seed, n, order):
    rng = np.random.default_rng(seed)
    model = nonlinear_model(n)
    mean, cov = 0.3 * rng.standard_normal((2, n)), 0.1 * random_cov(rng, n, 2)
    u, y = rng.standard_normal((2, 1)), rng.standard_normal((2, n // 2 + 1))
    estimator = GHKF(model, order=order)
    belief = estimator.predict(estimator.init(mean, cov), u, 0.0, 0.1)
    belief, _ = estimator.update(belief, y, u, 0.1)
    for run in range(2):
        x, P = textbook_ghkf(model, mean[run], cov[run], y[run], u[run], 0.1, order)
        np.testing.assert_allclose(belief.mean[run], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[run], P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("order", [2, 3, 5])
def test_the_rule_is_exact_to_degree_2_order_less_1(n, order):
    rule = gauss_hermite(n, order)
    assert rule.points.shape == (order**n, n)
    moments = {0: 1, 2: 1, 4: 3, 6: 15, 8: 105}
    for powers in itertools.product(range(2 * order), repeat=n):
        value = rule.mean_weights @ (rule.points ** np.array(powers)).prod(axis=-1)
        expected = np.prod([moments.get(p, 0) for p in powers])
        np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-8)


def test_order_three_in_one_dimension_is_the_unscented_rule_with_kappa_two():
    model = FunctionModel(
        lambda x, u, t, dt: np.sin(x), lambda x, u, t: x**2, 0.1 * np.eye(1), np.eye(1)
    )
    u, y = np.zeros((1, 0)), np.ones((1, 1))
    results = []
    for estimator in (GHKF(model), UKF(model, alpha=1.0, beta=0.0, kappa=2.0)):
        belief = estimator.init(np.array([[0.7]]), np.eye(1)[None])
        belief = estimator.predict(belief, u, 0.0, 1.0)
        results.append(estimator.update(belief, y, u, 1.0)[0])
    np.testing.assert_allclose(results[0].mean, results[1].mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(results[0].cov, results[1].cov, rtol=1e-10, atol=1e-12)


def test_a_redraw_that_is_no_switch_is_refused():
    for cls in (CKF, GHKF):
        with pytest.raises(EstimatorError, match="redraw is 'no'"):
            cls(nonlinear_model(2), redraw="no")  # pyright: ignore[reportArgumentType]


def test_too_many_points_are_refused_with_their_count():
    with pytest.raises(EstimatorError, match=r"order is 3 .* 8 dimensions.*3\^8 points"):
        GHKF(linear_model(0, 8, 1))
    GHKF(linear_model(0, 8, 1), order=2)
    wide = LinearModel(np.eye(400), np.eye(1, 400), np.eye(400), np.eye(1))
    with pytest.raises(EstimatorError, match="400 dimensions"):
        GHKF(wide, order=100)


@pytest.mark.parametrize("order", [1, 2.5, "three", 101, True])
def test_a_wrong_order_is_refused(order):
    with pytest.raises(EstimatorError, match="GHKF: order is"):
        GHKF(nonlinear_model(2), order=order)
