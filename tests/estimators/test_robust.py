from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.estimators.robust import RobustEKF
from tests.estimators.test_enkf import start
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_states

METHODS = ("gate_components", "gate", "huber", "student_t")


def problem(seed, runs=4, n=6):
    """A chain of pendulums, one of whose n/2 + 1 measured components is off by 30 σ."""
    model = nonlinear_model(n)
    mean, cov, u = start(model, runs, seed)
    y = model.measurement(mean, u, 0.0) + 0.1
    y[np.arange(runs), np.arange(runs) % (n // 2 + 1)] += 30 * np.sqrt(np.diag(model.R).max())
    return model, mean, cov, u, y


def kalman(P, H, nu, R):
    """δ and P⁺ of one linear update."""
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return K @ nu, (np.eye(len(P)) - K @ H) @ P


def huber_scale(e, P, H, L):
    """R̃ by Huber's weights of the residuals whitened by R."""
    white = np.linalg.inv(L) @ e
    return L @ np.diag(np.maximum(np.abs(white) / 1.345, 1.0)) @ L.T


def student_scale(e, P, H, L):
    """R̃ by the expected precision of a multivariate Student-t with 5 degrees of freedom."""
    square = np.trace(np.linalg.inv(L @ L.T) @ (np.outer(e, e) + H @ P @ H.T))
    return L @ L.T * (5.0 + square) / (5.0 + len(e))


@pytest.mark.parametrize("method", METHODS)
def test_without_outliers_or_with_wide_settings_it_is_the_ekf(method):
    model, mean, cov, u, y = problem(0)
    robust = RobustEKF(model, method=method, gate=1.0, threshold=1e9, degrees=1e14)
    a, b = robust.init(mean, cov), EKF(model).init(mean, cov)
    (a, one), (b, other) = robust.update(a, y, u, 0.0), EKF(model).update(b, y, u, 0.0)
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-9)
    np.testing.assert_allclose(a.cov, b.cov, atol=1e-9)
    np.testing.assert_allclose(one.nis, other.nis)


@pytest.mark.parametrize("seed", range(3))
def test_gates_leave_out_what_exceeds_the_chi_square_quantile(seed):
    model, mean, cov, u, y = problem(seed)
    ekf = EKF(model)
    belief = ekf.init(mean, cov)
    _, raw = ekf.update(belief, y, u, 0.0)
    variance = np.diagonal(raw.cov, axis1=1, axis2=2)
    gates: list[tuple[Any, Any]] = [
        ("gate_components", raw.residual**2 <= chi2.ppf(0.99, 1) * variance),
        ("gate", np.repeat(raw.nis[:, None] <= chi2.ppf(0.99, 4), 4, axis=1)),
    ]
    for method, passed in gates:
        assert not passed.all()
        expected, _ = ekf.update(belief, y, u, 0.0, mask=passed)
        got, innovation = RobustEKF(model, method=method, gate=0.99).update(belief, y, u, 0.0)
        np.testing.assert_allclose(got.mean, expected.mean, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(got.cov, expected.cov, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(innovation.nis, raw.nis)
        assert (innovation.dof == 4).all()


@pytest.mark.parametrize("seed", range(3))
def test_huber_reaches_the_minimum_of_its_loss(seed):
    model, mean, cov, u, y = problem(seed)
    robust = RobustEKF(model, method="huber", iterations=400)
    posterior, _ = robust.update(robust.init(mean, cov), y, u, 0.0)
    predicted, H = model.measurement_jacobian(mean, u, 0.0)
    L = np.linalg.cholesky(model.R)
    for i in range(len(y)):
        delta = posterior.mean[i] - mean[i]
        e = np.linalg.solve(L, y[i] - predicted[i] - H[i] @ delta)
        influence = np.clip(e, -1.345, 1.345)
        assert np.abs(e).max() > 1.345
        gradient = np.linalg.solve(cov[i], delta) - H[i].T @ np.linalg.solve(L.T, influence)
        np.testing.assert_allclose(gradient, 0, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
@pytest.mark.parametrize(
    ("method", "scale"), [("huber", huber_scale), ("student_t", student_scale)]
)
def test_reweighting_equals_the_textbook(method, scale, n, seed):
    model, mean, cov, u, y = problem(seed, n=n)
    robust = RobustEKF(model, method=method, degrees=5.0, iterations=6)
    posterior, _ = robust.update(robust.init(mean, cov), y, u, 0.0)
    predicted, H = model.measurement_jacobian(mean, u, 0.0)
    L = np.linalg.cholesky(model.R)
    for i in range(len(y)):
        R, nu = model.R, y[i] - predicted[i]
        for _ in range(6):
            delta, P = kalman(cov[i], H[i], nu, R)
            R = scale(nu - H[i] @ delta, P, H[i], L)
        assert np.trace(R) > 1.5 * np.trace(model.R)
        delta, P = kalman(cov[i], H[i], nu, R)
        np.testing.assert_allclose(posterior.mean[i], mean[i] + delta, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(posterior.cov[i], P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("method", METHODS)
def test_outliers_hurt_less_than_in_the_ekf(method):
    model = linear_model(7)
    runs, rng = 200, np.random.default_rng(0)
    u, x = np.zeros((runs, 1)), rng.standard_normal((runs, 3))
    filters = [RobustEKF(model, method=method), EKF(model)]
    beliefs = [f.init(np.zeros((runs, 3)), np.tile(np.eye(3), (runs, 1, 1))) for f in filters]
    LQ, LR = (
        0.1 * np.eye(3) @ np.linalg.cholesky(model.Q + 1e-12 * np.eye(3)),
        np.linalg.cholesky(model.R),
    )
    errors = np.zeros(2)
    for k in range(30):
        x = x @ model.A.T + rng.standard_normal((runs, 3)) @ LQ.T
        glitch = 50 * (rng.uniform(size=(runs, 1)) < 0.1)
        y = model.measurement(x, u) + (rng.standard_normal((runs, 2)) + glitch) @ LR.T
        for j, filter in enumerate(filters):
            beliefs[j] = filter.predict(beliefs[j], u, k, 1.0)
            beliefs[j], _ = filter.update(beliefs[j], y, u, k)
            errors[j] += ((beliefs[j].mean - x) ** 2).sum()
    assert errors[0] < 0.25 * errors[1]


@pytest.mark.parametrize("method", METHODS)
def test_missing_component_is_out_exactly(method):
    model = linear_model(3)
    mean, cov, u = start(model, 3)
    y = model.measurement(mean, u) + 5.0
    mask = np.array([[True, False], [False, False], [True, True]])
    robust = RobustEKF(model, method=method, gate=0.999999)
    belief = robust.init(mean, cov)
    posterior, innovation = robust.update(belief, np.where(mask, y, np.nan), u, 0.0, mask=mask)
    np.testing.assert_array_equal(innovation.dof, [1, 0, 2])
    np.testing.assert_allclose(posterior.mean[1], mean[1], atol=0)
    np.testing.assert_allclose(posterior.cov[1], cov[1], rtol=1e-10, atol=1e-15)
    full, _ = robust.update(belief, y, u, 0.0)
    np.testing.assert_array_equal(posterior.mean[2], full.mean[2])
    assert model.D is not None
    part = type(model)(model.A, model.C[:1], model.Q, model.R[:1, :1], model.B, model.D[:1])
    first, _ = RobustEKF(part, method=method, gate=0.999999).update(belief, y[:, :1], u, 0.0)
    np.testing.assert_allclose(posterior.mean[0], first.mean[0], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(posterior.cov[0], first.cov[0], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_a_failed_run_stands_alone(method):
    model = linear_model(5)
    mean, cov, u = start(model, 4)
    mean[1], cov[2] = np.nan, -10 * np.eye(3)
    robust = RobustEKF(model, method=method)
    belief = robust.predict(robust.init(mean, cov), u, 0.0, 1.0)
    belief, _ = robust.update(belief, np.ones((4, 2)), u, 1.0)
    np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, Fault.INNOVATION, 0])
    assert np.isfinite(belief.cov[[0, 3]]).all()


@pytest.mark.parametrize("method", METHODS)
def test_quaternion_measurements(method):
    model = mujoco_model("joints", density=1e-3)
    x, u = random_states(model.mjmodel, 3)
    n = model.space.n
    robust = RobustEKF(model, method=method)
    belief = robust.init(x, np.broadcast_to(1e-4 * np.eye(n), (3, n, n)))
    y = model.measurement(x, u, 0.0)
    y[:, 1:5] = [0.0, 1.0, 0.0, 0.0]  # the wrist reads half a turn
    y[:, 5:9] *= -1
    belief, innovation = robust.update(belief, y, u, 0.0)
    assert (innovation.nis > 100).all()
    limit = {"gate_components": 5e-3, "gate": 1e-12, "huber": 3e-3, "student_t": 1e-2}[method]
    assert np.abs(model.space.minus(belief.mean, x)).max() < limit


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"method": "hubert"}, "RobustEKF: method is 'hubert'; use one of gate_components, gate"),
        ({"gate": 0.0}, "RobustEKF: gate is 0.0"),
        ({"threshold": -1}, "RobustEKF: threshold is -1"),
        ({"degrees": 0}, "RobustEKF: degrees is 0"),
        ({"iterations": 0}, "RobustEKF: iterations is 0; use an integer of at least 1"),
    ],
)
def test_wrong_settings_say_so(settings, words):
    with pytest.raises(EstimatorError, match=words):
        RobustEKF(linear_model(0), **settings)
