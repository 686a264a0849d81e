import numpy as np
import pytest
from filterpy.kalman import CubatureKalmanFilter

from estbench.estimators.ckf import CKF
from estbench.estimators.sigma_points import cubature
from tests.helpers import nonlinear_model, random_cov


def textbook_ckf(model, x, P, ys, us, dt, redraw):
    """Arasaratnam & Haykin 2009, appendix A, with points in columns."""
    n = len(x)
    xi = np.sqrt(n) * np.hstack([np.eye(n), -np.eye(n)])
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        X = np.linalg.cholesky(P) @ xi + x[:, None]
        X = np.array([model.f(p, u, dt * k, dt) for p in X.T]).T
        x = X.mean(axis=1)
        P = X @ X.T / (2 * n) - np.outer(x, x) + model.Q
        if redraw:
            X = np.linalg.cholesky(P) @ xi + x[:, None]
        Z = np.array([model.h(p, u, dt * (k + 1)) for p in X.T]).T
        z = Z.mean(axis=1)
        S = Z @ Z.T / (2 * n) - np.outer(z, z) + model.R
        K = (X @ Z.T / (2 * n) - np.outer(x, z)) @ np.linalg.inv(S)
        x, P = x + K @ (y - z), P - K @ S @ K.T
    return x, P


def problem(seed, n, runs=3, steps=8):
    rng = np.random.default_rng(seed)
    model = nonlinear_model(n)
    mean, cov = 0.3 * rng.standard_normal((runs, n)), 0.1 * random_cov(rng, n, runs)
    us = rng.standard_normal((steps, runs, 1))
    # Readings of states nearby: far from them the rounding of X Xᵀ/2n - x xᵀ is amplified.
    ys = model.h(mean, us[0], 0.0) + 0.3 * rng.standard_normal((steps, runs, n // 2 + 1))
    return model, mean, cov, ys, us


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
@pytest.mark.parametrize("redraw", [True, False])
def test_equals_the_textbook(seed, n, redraw):
    model, mean, cov, ys, us = problem(seed, n)
    estimator = CKF(model, redraw=redraw)
    belief = estimator.init(mean, cov)
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        belief = estimator.predict(belief, u, 0.1 * k, 0.1)
        belief, _ = estimator.update(belief, y, u, 0.1 * (k + 1))
    for run in range(3):
        x, P = textbook_ckf(model, mean[run], cov[run], ys[:, run], us[:, run], 0.1, redraw)
        np.testing.assert_allclose(belief.mean[run], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[run], P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_equals_filterpy_which_does_not_redraw(seed):
    model, mean, cov, ys, us = problem(seed, 4, runs=1)
    u = us[0]

    def fx(x, dt):
        return model.f(x, u[0], 0.0, dt)

    peer = CubatureKalmanFilter(4, 3, 0.1, lambda x: model.h(x, u[0], 0.0), fx)
    peer.x, peer.P, peer.Q, peer.R = mean[0, :, None], cov[0], model.Q, model.R
    estimator = CKF(model, redraw=False)
    belief = estimator.init(mean, cov)
    for y in ys:
        belief, _ = estimator.update(estimator.predict(belief, u, 0.0, 0.1), y, u, 0.0)
        peer.predict()
        peer.update(y.T)
        np.testing.assert_allclose(belief.mean[0], peer.x[:, 0], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[0], peer.P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_the_rule_is_exact_to_the_third_degree(n):
    rule = cubature(n)
    xi, w = rule.points, rule.mean_weights
    assert len(xi) == 2 * n
    np.testing.assert_allclose(w.sum(), 1.0)
    np.testing.assert_allclose(w @ xi, 0.0, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose((w[:, None] * xi).T @ xi, np.eye(n), rtol=1e-10, atol=1e-14)
    third = np.einsum("p,pi,pj,pk->ijk", w, xi, xi, xi)
    np.testing.assert_allclose(third, 0.0, rtol=1e-10, atol=1e-14)
