from dataclasses import replace

import numpy as np
import pytest

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.converted import (
    FORMS,
    ConvertedEKF,
    convert_range_bearing,
    predicted_noise,
)
from estbench.estimators.ekf import EKF
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from estbench.spaces.linalg import quadratic_form
from tests.helpers import random_cov

DT = 1.0
A = np.eye(4) + DT * np.eye(4, k=2)
STATION = (10.0, -5.0)


def radar(std_range=1.0, std_bearing=0.1):
    """A target (x, y, vx, vy) seen in range, bearing, and, third, its speed along x."""

    def h(x, u, t):
        dx, dy = x[..., 0] - STATION[0], x[..., 1] - STATION[1]
        return np.stack([np.hypot(dx, dy), np.arctan2(dy, dx), x[..., 2]], axis=-1)

    return FunctionModel(
        lambda x, u, t, dt: x @ A.T, h, 0.01 * np.eye(4),
        np.diag([std_range**2, std_bearing**2, 4.0]), names=("x", "y", "vx", "vy"),
    )  # fmt: skip


def converted(model, **settings):
    return ConvertedEKF(model, range="y0", bearing="y1", origin=STATION, **settings)


def moments(r, theta, std_range, std_bearing):
    """Bias and covariance of r cos θ, r sin θ for a true (r, θ) (Lerro & Bar-Shalom, eq. 5-9)."""
    s2 = std_bearing**2
    length = np.exp(-s2 / 2)
    mean = length * r * np.array([np.cos(theta), np.sin(theta)])
    power = 0.5 * (r**2 + std_range**2)
    double = np.exp(-2 * s2) * np.array([np.cos(2 * theta), np.sin(2 * theta)])
    second = power * np.array([[1 + double[0], double[1]], [double[1], 1 - double[0]]])
    bias = mean - r * np.array([np.cos(theta), np.sin(theta)])
    return bias, second - np.outer(mean, mean)


def test_additive_form_is_the_mean_of_the_true_moments_given_the_measurement():
    """By Gauss-Hermite quadrature over the truth behind one measurement."""
    r, theta, std_range, std_bearing = 50.0, 0.7, 2.0, 0.15
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    weights = weights / weights.sum()
    bias, R = np.zeros(2), np.zeros((2, 2))
    for a, wa in zip(nodes, weights):
        for b, wb in zip(nodes, weights):
            one, cov = moments(r - std_range * a, theta - std_bearing * b, std_range, std_bearing)
            bias += wa * wb * one
            R += wa * wb * cov
    z, got = convert_range_bearing(np.array(r), np.array(theta), std_range, std_bearing, "additive")
    raw = r * np.array([np.cos(theta), np.sin(theta)])
    np.testing.assert_allclose(z, raw - bias, rtol=1e-10)
    np.testing.assert_allclose(got, R, rtol=1e-8)


def test_multiplicative_form_is_unbiased_and_has_the_covariance_of_the_truth_behind_it():
    r, theta, std_range, std_bearing = 50.0, 0.7, 2.0, 0.15
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    weights = np.outer(weights, weights).ravel() / weights.sum() ** 2
    a, b = (g.ravel() for g in np.meshgrid(std_range * nodes, std_bearing * nodes))
    z, _ = convert_range_bearing(r + a, theta + b, std_range, std_bearing)
    truth = r * np.array([np.cos(theta), np.sin(theta)])
    np.testing.assert_allclose(weights @ z, truth, rtol=1e-10)
    z, R = convert_range_bearing(np.array(r), np.array(theta), std_range, std_bearing)
    behind = (r - a)[:, None] * np.stack([np.cos(theta - b), np.sin(theta - b)], axis=-1)
    error = behind - z
    np.testing.assert_allclose((error * weights[:, None]).T @ error, R, rtol=1e-8)


@pytest.mark.parametrize("form", FORMS)
def test_small_noise_gives_the_linearized_covariance(form):
    rng = np.random.default_rng(0)
    r, theta = rng.uniform(1, 100, (3, 4)), rng.uniform(-4, 4, (3, 4))
    z, R = convert_range_bearing(r, theta, 1e-4 * r, 1e-4, form)
    T = np.array([[np.cos(theta), -r * np.sin(theta)], [np.sin(theta), r * np.cos(theta)]])
    T = np.moveaxis(T, (0, 1), (-2, -1))
    noise = np.zeros((3, 4, 2, 2))
    noise[..., 0, 0], noise[..., 1, 1] = (1e-4 * r) ** 2, 1e-8
    assert z.shape == (3, 4, 2)
    np.testing.assert_allclose(np.hypot(*np.moveaxis(z, -1, 0)), r, rtol=1e-7)
    linearized = T @ noise @ np.swapaxes(T, -1, -2)
    scale = np.trace(linearized, axis1=-2, axis2=-1)[..., None, None]
    np.testing.assert_allclose(R / scale, linearized / scale, atol=1e-6)


@pytest.mark.parametrize("std_range", [0.0, 2.0])
def test_decorrelated_noise_is_the_covariance_over_the_prior_and_the_noise(std_range):
    """By quadrature over position, range and bearing; exact without noise of the range."""
    position, cov, std_bearing = np.array([40.0, 30.0]), np.array([[9.0, 4.0], [4.0, 16.0]]), 0.2
    nodes, weights = np.polynomial.hermite_e.hermegauss(20)
    grid = np.array(np.meshgrid(*[nodes] * 4)).reshape(4, -1)
    weights = np.prod(np.meshgrid(*[weights / weights.sum()] * 4), axis=0).ravel()
    p = position + (np.linalg.cholesky(cov) @ grid[:2]).T
    r, theta = np.hypot(*p.T) + std_range * grid[2], np.arctan2(*p.T[::-1]) + std_bearing * grid[3]
    z, _ = convert_range_bearing(r, theta, std_range, std_bearing, "decorrelated")
    error = (z - p) * np.sqrt(weights)[:, None]
    R = predicted_noise(position, cov, std_range, std_bearing)
    np.testing.assert_allclose(R, error.T @ error, rtol=1e-10 if std_range == 0 else 1e-3)
    # Uncorrelated with the position, so that the Kalman update is the best linear one.
    cross = (weights[:, None] * (z - p)).T @ (p - position)
    np.testing.assert_allclose(cross, 0.0, atol=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_over_many_readings_only_the_decorrelated_form_stays_consistent(form):
    """A target at rest 1 km away, with a wide prior, whose bearing is seen to 0.2 rad."""
    model, runs, rng = radar(20.0, 0.2), 400, np.random.default_rng(3)
    model = replace(model, f=lambda x, u, t, dt: x, Q=1e-6 * np.eye(4))
    mean, P = np.array([900.0, 400.0, 0.0, 0.0]), np.diag([200.0, 200.0, 1.0, 1.0]) ** 2
    truth = mean + rng.standard_normal((runs, 4)) @ np.sqrt(P)
    filter, u = converted(model, form=form), np.empty((runs, 0))
    belief = filter.init(np.tile(mean, (runs, 1)), np.tile(P, (runs, 1, 1)))
    for k in range(30):
        noise = rng.standard_normal((runs, 3)) * np.sqrt(np.diag(model.R))
        y = model.measurement(truth, u, 0.0) + noise
        belief, _ = filter.update(filter.predict(belief, u, k, DT), y, u, k)
    nees = quadratic_form(belief.cov[:, :2, :2], truth[:, :2] - belief.mean[:, :2]) / 2
    band = 4 * nees.std() / np.sqrt(runs)  # a false alarm in 6e-5 of the seeds
    assert (abs(nees.mean() - 1) < band) == (form == "decorrelated")


def test_far_target_with_coarse_bearing_is_unbiased_where_the_standard_form_is_not():
    rng, count = np.random.default_rng(0), 200_000
    r, theta, std_range, std_bearing = 100.0, 0.5, 1.0, 0.2
    truth = r * np.array([np.cos(theta), np.sin(theta)])
    measured = (
        r + std_range * rng.standard_normal(count),
        theta + std_bearing * rng.standard_normal(count),
    )
    radial = truth / r
    for form in FORMS:
        unbiased = form != "standard"
        z, R = convert_range_bearing(*measured, std_range, std_bearing, form)
        along = (z - truth) @ radial
        spread = 4 * along.std() / np.sqrt(count)
        # The additive form averages the bias over the measurement, which leaves order σ⁴.
        assert (abs(along.mean()) < spread + r * std_bearing**4) == unbiased
        square = np.einsum("ki,kij,kj->k", z - truth, np.linalg.inv(R), z - truth) / 2
        if unbiased:
            assert abs(square.mean() - 1) < 0.1


def problem(runs=3):
    rng = np.random.default_rng(1)
    mean = np.array([100.0, 80.0, -1.0, 0.5]) + rng.standard_normal((runs, 4))
    cov = np.stack([random_cov(rng, 4, scale=100.0) for _ in range(runs)])
    u = np.empty((runs, 0))
    model = radar()
    y = model.measurement(mean + 5 * rng.standard_normal((runs, 4)), u, 0.0)
    return model, mean, cov, u, y


@pytest.mark.parametrize("form", FORMS)
def test_update_is_the_kalman_update_of_the_converted_measurement(form):
    model, mean, cov, u, y = problem()
    filter = converted(model, form=form)
    posterior, innovation = filter.update(filter.init(mean, cov), y, u, 0.0)
    z, R = convert_range_bearing(y[:, 0], y[:, 1], 1.0, 0.1, form)
    if form == "decorrelated":
        R = predicted_noise(mean[:, :2] - STATION, cov[:, :2, :2], 1.0, 0.1)
    full = np.zeros((3, 3, 3))
    full[:, :2, :2], full[:, 2, 2] = R, 4.0
    linear = LinearModel(A, np.eye(4)[:3], model.Q, full)
    reference = EKF(linear)
    data = np.concatenate([z + STATION, y[:, 2:]], axis=-1)
    expected, other = reference.update(reference.init(mean, cov), data, u, 0.0)
    np.testing.assert_allclose(posterior.mean, expected.mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(posterior.cov, expected.cov, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(innovation.nis, other.nis)


def test_one_of_the_two_alone_is_the_ekf_and_nothing_changes_nothing():
    model, mean, cov, u, y = problem(4)
    mask = np.array([[True, False, True], [False, True, True], [False, False, False], [True] * 3])
    filter, ekf = converted(model), EKF(model)
    belief, seen = filter.init(mean, cov), np.where(mask, y, np.nan)
    posterior, innovation = filter.update(belief, seen, u, 0.0, mask=mask)
    expected, _ = ekf.update(belief, seen, u, 0.0, mask=mask)
    full, _ = filter.update(belief, y, u, 0.0)
    np.testing.assert_allclose(posterior.mean[:3], expected.mean[:3], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(posterior.cov[:3], expected.cov[:3], rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(posterior.mean[2], mean[2])
    np.testing.assert_array_equal(posterior.mean[3], full.mean[3])
    assert np.abs(full.mean[3] - expected.mean[3]).max() > 1e-3
    np.testing.assert_array_equal(innovation.dof, [2, 2, 0, 3])


def test_without_names_it_is_the_ekf_and_a_failed_run_stands_alone():
    model, mean, cov, u, y = problem()
    mean[1] = np.nan
    for filter in (ConvertedEKF(model), converted(model)):
        belief = filter.predict(filter.init(mean, cov), u, 0.0, DT)
        posterior, _ = filter.update(belief, y, u, 0.0)
        np.testing.assert_array_equal(posterior.fault, [0, Fault.STATE, 0])
        assert np.isfinite(posterior.cov[[0, 2]]).all()
    expected, _ = EKF(model).update(EKF(model).init(mean, cov), y, u, 0.0)
    plain, _ = ConvertedEKF(model).update(EKF(model).init(mean, cov), y, u, 0.0)
    np.testing.assert_array_equal(plain.mean, expected.mean)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"range": "y0"}, "ConvertedEKF: range is 'y0' and bearing None; give both"),
        ({"range": "y0", "bearing": "y7"}, "ConvertedEKF: bearing is 'y7'; there is none"),
        (
            {"range": "y0", "bearing": "y1", "position": ("x", "z")},
            "ConvertedEKF: position is 'z'; there is none",
        ),
        ({"origin": (0.0,)}, "ConvertedEKF: .* give two names and two numbers"),
        ({"form": "biased"}, "ConvertedEKF: form is 'biased'; use one of decorrelated, multipl"),
    ],
)
def test_wrong_settings_say_so(settings, words):
    with pytest.raises(EstimatorError, match=words):
        ConvertedEKF(radar(), **settings)
