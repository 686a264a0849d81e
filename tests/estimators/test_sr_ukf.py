import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.sr_ukf import SquareRootUKF
from estbench.models.function import FunctionModel
from tests.helpers import nonlinear_model, random_cov

RULES = [(1.0, 2.0, 0.0), (0.5, 2.0, 1.0), (0.1, 2.0, 0.0), (1.0, 0.0, -0.5)]


def textbook_ukf(model, x, P, ys, us, dt, alpha, beta, kappa):
    """Source 003, eq. 10-11."""
    n = len(x)
    spread = alpha**2 * (n + kappa)
    wm = np.full(2 * n + 1, 0.5 / spread)
    wm[0] = 1.0 - n / spread
    W = np.diag(wm)
    W[0, 0] += 1.0 - alpha**2 + beta
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        for stage in ("time", "measurement"):
            root = np.sqrt(spread) * np.linalg.cholesky(P)
            X = np.array([x, *(x + root.T), *(x - root.T)])
            if stage == "time":
                X = np.array([model.f(p, u, dt * k, dt) for p in X])
                x = wm @ X
                P = (X - x).T @ W @ (X - x) + model.Q
        Y = np.array([model.h(p, u, dt * (k + 1)) for p in X])
        predicted = wm @ Y
        S = (Y - predicted).T @ W @ (Y - predicted) + model.R
        K = (X - x).T @ W @ (Y - predicted) @ np.linalg.inv(S)
        x, P = x + K @ (y - predicted), P - K @ S @ K.T
    return x, P


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("n", [2, 4, 6])
@pytest.mark.parametrize("rule", RULES)
def test_equals_the_textbook_ukf(seed, n, rule):
    rng = np.random.default_rng(seed)
    model = nonlinear_model(n)
    mean, cov = 0.3 * rng.standard_normal((3, n)), 0.05 * random_cov(rng, n, 3)
    us = rng.standard_normal((8, 3, 1))
    ys = model.h(mean, us[0], 0.0) + 0.3 * rng.standard_normal((8, 3, n // 2 + 1))
    estimator = SquareRootUKF(model, *rule)
    belief = estimator.init(mean, cov)
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        belief = estimator.predict(belief, u, 0.1 * k, 0.1)
        belief, _ = estimator.update(belief, y, u, 0.1 * (k + 1))
    for run in range(3):
        x, P = textbook_ukf(model, mean[run], cov[run], ys[:, run], us[:, run], 0.1, *rule)
        np.testing.assert_allclose(estimator.mean(belief)[run], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimator.cov(belief)[run], P, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(belief.factor, np.tril(belief.factor))


@pytest.mark.parametrize("seed", range(3))
def test_equals_filterpy(seed):
    rng = np.random.default_rng(seed)
    model, n, m, dt = nonlinear_model(4), 4, 3, 0.1
    mean, cov = 0.3 * rng.standard_normal((1, n)), 0.05 * random_cov(rng, n, 1)
    u = rng.standard_normal((1, 1))
    points = MerweScaledSigmaPoints(n, 0.5, 2.0, 1.0)
    peer = UnscentedKalmanFilter(
        n, m, dt, lambda x: model.h(x, u[0], 0.0), lambda x, dt: model.f(x, u[0], 0.0, dt), points
    )
    peer.x, peer.P, peer.Q, peer.R = mean[0].copy(), cov[0].copy(), model.Q, model.R
    estimator = SquareRootUKF(model, 0.5, 2.0, 1.0)
    belief = estimator.init(mean, cov)
    for _ in range(8):
        y = model.h(mean, u, 0.0) + 0.2 * rng.standard_normal((1, m))
        belief, _ = estimator.update(estimator.predict(belief, u, 0.0, dt), y, u, dt)
        peer.predict()
        peer.update(y[0])
        np.testing.assert_allclose(belief.mean[0], peer.x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[0], peer.P, rtol=1e-10, atol=1e-10)


def test_a_lost_prediction_is_named_in_its_own_run():
    """A large negative centre weight and a fold at the mean take more than the others give."""
    model = FunctionModel(
        lambda x, u, t, dt: x**2,
        lambda x, u, t: x[..., :1] ** 2,
        1e-6 * np.eye(2),
        1e-6 * np.eye(1),
    )
    estimator = SquareRootUKF(model, alpha=1.0, beta=0.0, kappa=-1.5)
    belief = estimator.init(np.array([[0.0, 0.0], [3.0, 3.0]]), np.stack([np.eye(2)] * 2))
    u = np.zeros((2, 0))
    prior = estimator.predict(belief, u, 0.0, 1.0)
    np.testing.assert_array_equal(prior.fault, [Fault.COVARIANCE, 0])
    assert np.isnan(prior.mean[0]).all()
    assert np.isfinite(prior.mean[1]).all()
    posterior, _ = estimator.update(belief, np.ones((2, 1)), u, 0.0)
    assert posterior.fault[0] == Fault.INNOVATION


@pytest.mark.parametrize(
    "settings",
    [{"alpha": 0.0}, {"alpha": 1.5}, {"beta": -1.0}, {"kappa": -2.0}, {"kappa": float("inf")}],
)
def test_wrong_settings_are_refused(settings):
    (name,) = settings
    with pytest.raises(EstimatorError, match=f"SquareRootUKF: {name} is"):
        SquareRootUKF(nonlinear_model(2), **settings)
