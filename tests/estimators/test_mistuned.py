"""A filter with wrong noise covariances is inconsistent by as much as linear theory says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from estbench.estimators import registry
from estbench.spaces.linalg import quadratic_form
from tests.helpers import linear_model, random_cov


def expected(model, filter_model):
    """Mean NEES = tr(P⁺⁻¹ Σ), Σ the true error covariance under the filter's steady gain.

    Σ = A Σ Aᵀ + (I - K H) Q (I - K H)ᵀ + K R Kᵀ with A = (I - K H) F (Bar-Shalom, Li & Kirubarajan
    2001, sec. 5.5).
    """
    F, H, Q, R = model.A, model.C, filter_model.Q, filter_model.R
    prior = solve_discrete_are(F.T, H.T, Q, R)
    K = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R)
    left = np.eye(len(F)) - K @ H
    P = left @ prior
    true = solve_discrete_lyapunov(left @ F, left @ model.Q @ left.T + K @ model.R @ K.T)
    return np.trace(np.linalg.solve(P, true))


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf", "sr_ekf"])
@pytest.mark.parametrize(("q", "r"), [(1.0, 1.0), (0.05, 1.0), (20.0, 1.0), (1.0, 0.2)])
def test_mean_nees_is_that_of_the_lyapunov_equation(name, q, r):
    rng = np.random.default_rng(1)
    model = replace(linear_model(1), Q=random_cov(rng, 3))
    filter_model = replace(model, Q=q * model.Q, R=r * model.R)
    estimator = registry.create(name, {}, filter_model)
    runs, warmup, steps = 1000, 40, 60
    root_Q, root_R = np.linalg.cholesky(model.Q), np.linalg.cholesky(model.R)
    x, u = np.zeros((runs, 3)), np.zeros((runs, 1))
    belief = estimator.init(x, np.tile(np.eye(3), (runs, 1, 1)))
    nees = []
    for k in range(warmup + steps):
        x = model.transition(x, u) + rng.standard_normal((runs, 3)) @ root_Q.T
        y = model.measurement(x, u) + rng.standard_normal((runs, 2)) @ root_R.T
        belief, _ = estimator.update(estimator.predict(belief, u, k, 1.0), y, u, k + 1.0)
        if k >= warmup:
            nees.append(quadratic_form(estimator.cov(belief), x - estimator.mean(belief)))
    means = np.mean(nees, axis=0)
    error = means.std() / np.sqrt(runs)
    theory = expected(model, filter_model)
    assert abs(means.mean() - theory) < 4 * error  # a false alarm in 6e-5 of the seeds
    assert error < 0.02 * theory
    if q == r == 1.0:
        assert theory == pytest.approx(3.0)
    else:
        assert abs(theory - 3.0) > 0.5
