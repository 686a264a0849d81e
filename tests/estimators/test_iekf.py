import numpy as np
import pytest
from scipy.optimize import least_squares

from estbench.errors import EstimatorError
from estbench.estimators.ekf import EKF
from estbench.estimators.iekf import IEKF
from estbench.models.function import FunctionModel
from tests.helpers import mujoco_model, nonlinear_model, random_cov, random_states


def textbook_iekf(model, x0, P, y, u, iterations):
    x, K, H = x0, None, None
    for _ in range(iterations):
        H = model.h_jacobian(x, u, 0.0)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + model.R)
        x = x0 + K @ (y - model.h(x, u, 0.0) - H @ (x0 - x))
    assert K is not None
    assert H is not None
    return x, (np.eye(len(x0)) - K @ H) @ P


def problem(seed, n, runs=4):
    rng = np.random.default_rng(seed)
    model = nonlinear_model(n)
    mean, cov = 0.3 * rng.standard_normal((runs, n)), 0.3 * random_cov(rng, n, runs)
    u = rng.standard_normal((runs, 1))
    y = model.h(mean + 0.3 * rng.standard_normal((runs, n)), u, 0.0)
    return model, mean, cov, u, y


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
@pytest.mark.parametrize("iterations", [1, 2, 6])
def test_equals_the_textbook(seed, n, iterations):
    model, mean, cov, u, y = problem(seed, n)
    estimator = IEKF(model, iterations=iterations, tolerance=0.0)
    belief, _ = estimator.update(estimator.init(mean, cov), y, u, 0.0)
    for run in range(4):
        x, P = textbook_iekf(model, mean[run], cov[run], y[run], u[run], iterations)
        np.testing.assert_allclose(belief.mean[run], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[run], P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("form", ["joseph", "simplified", "symmetric"])
def test_every_covariance_form_agrees(form):
    model, mean, cov, u, y = problem(0, 4)
    estimators = IEKF(model, form), IEKF(model)
    a, b = (e.update(e.init(mean, cov), y, u, 0.0)[0].cov for e in estimators)
    np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


def test_one_iteration_is_the_ekf_and_the_innovation_is_always_the_ekfs():
    model, mean, cov, u, y = problem(1, 4)
    once, many, ekf = IEKF(model, iterations=1), IEKF(model), EKF(model)
    a, _ = once.update(once.init(mean, cov), y, u, 0.0)
    b, first = ekf.update(ekf.init(mean, cov), y, u, 0.0)
    _, innovation = many.update(many.init(mean, cov), y, u, 0.0)
    # Up to rounding, since only the EKF may take the compiled loop.
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-13)
    np.testing.assert_allclose(a.cov, b.cov, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(innovation.nis, first.nis, rtol=1e-13)


def mode(model, mean, cov, y, u):
    """The posterior mode by scipy, in the chart at the prior mean."""
    prior, noise = np.linalg.cholesky(cov), np.linalg.cholesky(model.measurement_noise(0.0))

    def residuals(white):
        x = model.space.plus(mean, prior @ white)
        predicted = model.measurement(x[None], u[None], 0.0)[0]
        return np.concatenate([white, np.linalg.solve(noise, model.output().minus(y, predicted))])

    return model.space.plus(
        mean,
        prior
        @ least_squares(residuals, np.zeros(len(prior)), xtol=1e-14, ftol=1e-14, gtol=1e-14).x,
    )


@pytest.mark.parametrize("seed", range(3))
def test_converges_to_the_posterior_mode(seed):
    model, mean, cov, u, y = problem(seed, 4)
    estimator = IEKF(model, iterations=200, tolerance=1e-12)
    belief, _ = estimator.update(estimator.init(mean, cov), y, u, 0.0)
    for run in range(4):
        expected = mode(model, mean[run], cov[run], y[run], u[run])
        np.testing.assert_allclose(belief.mean[run], expected, atol=1e-6)


def test_converges_to_the_posterior_mode_on_a_curved_state():
    model = mujoco_model("joints", channels=["lift_encoder", "gyro"])
    x, u = random_states(model.mjmodel, 2, seed=1)
    truth, _ = random_states(model.mjmodel, 2, seed=2)
    cov = 0.3 * random_cov(np.random.default_rng(1), model.space.n, 2)
    y = model.measurement(truth, u, 0.0)
    estimator = IEKF(model, iterations=100, tolerance=1e-9)
    belief, _ = estimator.update(estimator.init(x, cov), y, u, 0.0)
    for run in range(2):
        expected = mode(model, x[run], cov[run], y[run], u[run])
        error = model.space.minus(belief.mean[run], expected)
        np.testing.assert_allclose(error, 0.0, atol=1e-4)


def test_a_run_does_not_depend_on_how_long_its_companions_iterate():
    model, mean, cov, u, y = problem(3, 4)
    y[0] = model.h(mean[0], u[0], 0.0)  # done at once
    estimator = IEKF(model, iterations=30, tolerance=1e-3)
    together, _ = estimator.update(estimator.init(mean, cov), y, u, 0.0)
    for run in range(4):
        row = slice(run, run + 1)
        alone, _ = estimator.update(estimator.init(mean[row], cov[row]), y[row], u[row], 0.0)
        np.testing.assert_allclose(together.mean[row], alone.mean, rtol=0, atol=1e-13)
        np.testing.assert_allclose(together.cov[row], alone.cov, rtol=0, atol=1e-13)


def test_beats_the_ekf_on_a_precise_range_and_bearing():
    model = FunctionModel(
        lambda x, u, t, dt: x,
        lambda x, u, t: np.stack(
            [np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], axis=-1
        ),
        np.zeros((2, 2)),
        np.diag([1e-4, 1e-6]),
    )
    rng = np.random.default_rng(4)
    runs = 200
    mean = np.broadcast_to([3.0, 1.0], (runs, 2))
    cov = np.broadcast_to(0.25 * np.eye(2), (runs, 2, 2))
    truth = mean + 0.5 * rng.standard_normal((runs, 2))
    u = np.zeros((runs, 0))
    y = model.measurement(truth, u) + rng.standard_normal((runs, 2)) * [1e-2, 1e-3]
    rms = []
    for estimator in (IEKF(model, iterations=10), EKF(model)):
        belief, _ = estimator.update(estimator.init(mean, cov), y, u, 0.0)
        rms.append(np.sqrt(np.mean((belief.mean - truth) ** 2)))
    assert rms[0] < 0.2 * rms[1]


@pytest.mark.parametrize(
    "settings", [{"iterations": 0}, {"iterations": 2.5}, {"tolerance": -1.0}, {"tolerance": "x"}]
)
def test_wrong_settings_are_refused(settings):
    (name,) = settings
    with pytest.raises(EstimatorError, match=f"IEKF: {name} is"):
        IEKF(nonlinear_model(2), **settings)


def test_an_inherited_setting_is_checked():
    with pytest.raises(EstimatorError, match="IEKF: covariance_update is"):
        IEKF(nonlinear_model(2), covariance_update="none")  # pyright: ignore[reportArgumentType]
