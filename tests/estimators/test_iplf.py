import numpy as np
import pytest

from estbench.estimators.ghkf import GHKF
from estbench.estimators.iplf import IPLF
from estbench.estimators.rotated_ukf import RotatedUKF
from estbench.estimators.ukf import MEASUREMENT, UKF
from estbench.models.function import FunctionModel
from estbench.spaces.linalg import quadratic_form
from tests import pendulum
from tests.estimators.test_enkf import start
from tests.helpers import nonlinear_model

BASES = {"ukf": UKF, "ghkf": GHKF, "rotated_ukf": RotatedUKF}


def textbook(model, mean, cov, y, u, unit, weights, omega, iterations):
    """One run after García-Fernández et al. (2015), in the state's coordinates."""
    x, P = mean, cov
    for _ in range(iterations):
        points = [x + np.linalg.cholesky(P) @ xi for xi in unit]
        images = [model.measurement(p[None], u[None], 0.0)[0] for p in points]
        h = sum(w * image for w, image in zip(weights[0], images))
        cross = sum(w * np.outer(p - x, z - h) for w, p, z in zip(weights[1], points, images))
        spread = sum(w * np.outer(z - h, z - h) for w, z in zip(weights[1], images))
        H = cross.T @ np.linalg.inv(P)
        noise = (1 + omega) * (spread - H @ P @ H.T) + model.measurement_noise(0.0)
        S = H @ cov @ H.T + noise
        K = cov @ H.T @ np.linalg.inv(S)
        x, P = mean + K @ (y - h - H @ (mean - x)), cov - K @ S @ K.T
    return x, P


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("iterations", [1, 2, 5])
@pytest.mark.parametrize("n", [2, 4])
def test_equals_the_textbook(base, iterations, n):
    model = nonlinear_model(n)
    mean, cov, u = start(model, 3)
    plain = BASES[base](model)
    filter = IPLF(model, base=base, iterations=iterations, tolerance=0.0)
    belief = filter.init(mean, cov)
    rule = plain.rule_at(belief, MEASUREMENT)
    y = model.measurement(mean, u, 0.0) + 0.2
    posterior, innovation = filter.update(belief, y, u, 0.0)
    _, first = plain.update(belief, y, u, 0.0)
    np.testing.assert_allclose(innovation.nis, first.nis, rtol=1e-10)
    np.testing.assert_allclose(innovation.cov, first.cov, rtol=1e-10)
    for i in range(3):
        unit = rule.points[i] if rule.points.ndim == 3 else rule.points
        weights = rule.mean_weights, rule.cov_weights
        x, P = textbook(
            model, mean[i], cov[i], y[i], u[i], unit, weights, plain.omega, iterations
        )  # fmt: skip
        np.testing.assert_allclose(posterior.mean[i], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(posterior.cov[i], P, rtol=1e-10, atol=1e-10)


def test_the_printed_error_of_the_pendulum():
    """Särkkä & Svensson (2023), example 10.13: IPLF RMSE 0.14056 (third-order Gauss-Hermite)."""
    settings = {"base": "ghkf", "iterations": 10, "tolerance": 0.0}
    assert pendulum.rmse("iplf", settings) == pytest.approx(0.14056, abs=1e-5)


def test_a_coordinate_that_is_known_exactly_stays_so():
    model = nonlinear_model(4)
    mean, cov, u = start(model, 2)
    cov = 1e-4 * cov  # so that the points' axes, which the square root decides, do not matter
    cov[:, 2], cov[:, :, 2] = 0.0, 0.0
    filter = IPLF(model, iterations=4, tolerance=0.0)
    y = model.measurement(mean, u, 0.0) + 0.02
    posterior, _ = filter.update(filter.init(mean, cov), y, u, 0.0)
    np.testing.assert_array_equal(posterior.mean[:, 2], mean[:, 2])
    np.testing.assert_allclose(posterior.cov[:, 2], 0.0, atol=1e-15)
    assert not posterior.fault.any()
    nearly = cov + 1e-14 * np.eye(4)
    other, _ = filter.update(filter.init(mean, nearly), y, u, 0.0)
    np.testing.assert_allclose(posterior.mean, other.mean, atol=1e-6)
    np.testing.assert_allclose(posterior.cov, other.cov, atol=1e-6)


def test_a_converged_run_is_left_alone():
    model = nonlinear_model(4)
    mean, cov, u = start(model, 3)
    cov = 0.1 * cov
    y = model.measurement(mean, u, 0.0) + 0.2
    few, many = (IPLF(model, iterations=k, tolerance=1e-6) for k in (100, 200))
    one, other = (f.update(f.init(mean, cov), y, u, 0.0)[0] for f in (few, many))
    np.testing.assert_array_equal(one.mean, other.mean)
    fine = IPLF(model, iterations=200, tolerance=0.0)
    exact = fine.update(fine.init(mean, cov), y, u, 0.0)[0]
    np.testing.assert_allclose(one.mean, exact.mean, atol=1e-5)


def test_a_precise_range_and_a_poor_prior():
    """Range to 1 mm and bearing to 1 mrad of a point at 1 m, known to 0.3 m; 400 seeded runs.

    The UKF adds the curvature over the prior to S, and stays 130 times as far off as the iterated
    filter, which linearizes where the posterior is. The mean NEES of 2 has a standard error of 0.1:
    a fresh seed would fail with probability 1e-4.
    """
    runs, rng = 400, np.random.default_rng(0)

    def h(x, u, t):
        return np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], -1)

    model = FunctionModel(
        lambda x, u, t, dt: x, h, np.zeros((2, 2)), np.diag([1e-3, 1e-3]) ** 2, angles=[1]
    )
    mean, cov = np.tile([1.0, 0.0], (runs, 1)), np.tile(0.09 * np.eye(2), (runs, 1, 1))
    truth = mean + 0.3 * rng.standard_normal((runs, 2))
    y = h(truth, None, 0.0) + 1e-3 * rng.standard_normal((runs, 2))
    errors = {}
    for filter in (UKF(model), IPLF(model, iterations=20)):
        belief, _ = filter.update(filter.init(mean, cov), y, np.zeros((runs, 0)), 0.0)
        errors[type(filter)] = np.sqrt(np.mean((belief.mean - truth) ** 2))
        if isinstance(filter, IPLF):
            nees = quadratic_form(belief.cov, belief.mean - truth)
    assert errors[IPLF] < errors[UKF] / 50
    assert 1.6 < nees.mean() < 2.4
