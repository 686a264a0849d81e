from dataclasses import replace

import numpy as np
import pytest

from estbench.errors import EstimatorError, ScenarioError
from estbench.estimators.adaptive import AdaptiveEKF
from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.models.linear import LinearModel
from tests.estimators.test_enkf import start
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_states


def test_without_adaptation_it_is_the_ekf():
    model = nonlinear_model(4)
    mean, cov, u = start(model, 3)
    adaptive, ekf = AdaptiveEKF(model, adapt="none"), EKF(model)
    a, b = adaptive.init(mean, cov), ekf.init(mean, cov)
    for k in range(5):
        a, b = adaptive.predict(a, u, k, 0.05), ekf.predict(b, u, k, 0.05)
        y = model.measurement(mean, u, 0.0) + 0.1
        a, b = adaptive.update(a, y, u, k)[0], ekf.update(b, y, u, k)[0]
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(a.cov, b.cov, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("adapt", ["R", "Q", "both"])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (4, 5)])
def test_equals_the_textbook(n, m, seed, adapt):
    model, window, dt = linear_model(seed, n, m), 7, 0.5
    assert model.B is not None
    assert model.D is not None
    mean, cov, u = start(model, 3)
    filter = AdaptiveEKF(model, adapt=adapt, window=window)
    belief = filter.init(mean, cov)
    ys = np.random.default_rng(seed).standard_normal((12, 3, m)) * 3
    for k, y in enumerate(ys):
        belief = filter.predict(belief, u, k * dt, dt)
        belief, _ = filter.update(belief, y, u, (k + 1) * dt)
    A, C = model.A, model.C
    correlation = model.R / np.sqrt(np.outer(np.diag(model.R), np.diag(model.R)))
    for i in range(3):
        x, P, Q, r = mean[i], cov[i], model.Q, np.diag(model.R).copy()
        for y in ys[:, i]:
            x, P = A @ x + model.B @ u[i], A @ P @ A.T + Q
            R = correlation * np.sqrt(np.outer(r, r))
            nu, S = y - C @ x - model.D @ u[i], C @ P @ C.T + R
            K = P @ C.T @ np.linalg.inv(S)
            x, P = x + K @ nu, (np.eye(n) - K @ C) @ P
            eta = nu - C @ (K @ nu)
            if adapt != "Q":
                r = (1 - 1 / window) * r + (eta**2 + np.diag(C @ P @ C.T)) / window
            if adapt != "R":
                Q = Q + K @ (np.outer(nu, nu) - S) @ K.T / window
                values, vectors = np.linalg.eigh(Q)
                Q = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
        np.testing.assert_allclose(belief.mean[i], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[i], P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("adapt", ["R", "Q"])
def test_finds_a_wrong_noise_level(adapt):
    """A random walk; the adapted noise has variance 0.04, the other one 0.01."""
    runs, rng, one = 100, np.random.default_rng(0), np.eye(1)
    q, r = (0.01, 0.04) if adapt == "R" else (0.04, 0.01)
    wrong = LinearModel(one, one, q * one, 16 * r * one)
    if adapt == "Q":
        wrong = LinearModel(one, one, q / 16 * one, r * one)
    filter = AdaptiveEKF(wrong, adapt=adapt, window=20)
    u, x = np.empty((runs, 0)), np.zeros((runs, 1))
    belief = filter.init(x, np.tile(one, (runs, 1, 1)))
    nis, estimates = [], []
    for k in range(800):
        x = x + np.sqrt(q) * rng.standard_normal((runs, 1))
        y = x + np.sqrt(r) * rng.standard_normal((runs, 1))
        belief = filter.predict(belief, u, k, 1.0)
        belief, innovation = filter.update(belief, y, u, k)
        assert belief.density is not None
        nis.append(innovation.nis.mean())
        estimates.append(belief.variance.mean() if adapt == "R" else belief.density.mean())
    # The estimate itself varies by about sqrt(1/window), which biases E 1/S by 1/window.
    assert abs(np.mean(estimates[-400:]) / 0.04 - 1) < 0.1
    assert not 0.7 < np.mean(nis[2:12]) < 1.4  # the level was wrong, and was found
    assert abs(np.mean(nis[-400:]) - 1) < 1.5 / 20


def test_enlargements():
    model = linear_model(4)
    mean, cov, u = start(model, 2)
    filter = AdaptiveEKF(
        model, adapt="none", inflation={"x1": 1.5}, fading=1.2, pseudo_noise=[0.1, 0.0, 0.3]
    )
    prior = filter.predict(filter.init(mean, cov), u, 0.0, 0.5)
    upsilon = np.diag([1, 1.5, 1])
    for i in range(2):
        P = 1.44 * model.A @ cov[i] @ model.A.T + model.Q + 0.5 * np.diag([0.1, 0, 0.3])
        np.testing.assert_allclose(prior.cov[i], upsilon @ P @ upsilon.T, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("adapt", ["none", "R", "Q", "both"])
def test_missing_component_is_out_exactly(adapt):
    model = linear_model(3)
    mean, cov, u = start(model, 3)
    filter = AdaptiveEKF(model, adapt=adapt, window=3)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 1.0)
    y = model.measurement(mean, u) + 2.0
    mask = np.array([[True, False], [False, False], [True, True]])
    posterior, innovation = filter.update(belief, np.where(mask, y, np.nan), u, 1.0, mask=mask)
    full, _ = filter.update(belief, y, u, 1.0)
    names = ("mean", "cov", "variance", "density", "elapsed")
    for name in names:
        one, prior, whole = (getattr(b, name) for b in (posterior, belief, full))
        np.testing.assert_array_equal(one[1], prior[1])
        np.testing.assert_array_equal(one[2], whole[2])
    np.testing.assert_array_equal(innovation.dof, [1, 0, 2])
    np.testing.assert_array_equal(posterior.elapsed, [0, 1, 0])
    assert model.D is not None
    part = LinearModel(model.A, model.C[:1], model.Q, model.R[:1, :1], model.B, model.D[:1])
    other = AdaptiveEKF(part, adapt=adapt, window=3)
    prior = replace(belief, variance=belief.variance[:, :1])
    first, _ = other.update(prior, y[:, :1], u, 1.0)
    for name in names:
        one, whole = getattr(posterior, name)[0], getattr(first, name)[0]
        if name == "variance":
            assert np.isnan(one[1])
            one = one[:1]
        np.testing.assert_allclose(one, whole, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("adapt", ["R", "both"])
def test_a_failed_run_stands_alone(adapt):
    model = linear_model(5)
    mean, cov, u = start(model, 4)
    mean[1], cov[2] = np.nan, -10 * np.eye(3)
    filter = AdaptiveEKF(model, adapt=adapt)
    belief = filter.init(mean, cov)
    for k in range(3):
        belief = filter.predict(belief, u, k, 1.0)
        belief, _ = filter.update(belief, np.ones((4, 2)), u, k + 1)
    np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, Fault.INNOVATION, 0])
    assert np.isfinite(belief.cov[[0, 3]]).all()
    assert np.isfinite(belief.variance[[0, 3]]).all() == (adapt != "Q")


def test_quaternions_and_channels_of_different_rates():
    model = mujoco_model("joints", density=1e-3)
    x, u = random_states(model.mjmodel, 3)
    n = model.space.n
    filter = AdaptiveEKF(model, adapt="both", window=5)
    belief = filter.init(x, np.broadcast_to(1e-3 * np.eye(n), (3, n, n)))
    for k in range(6):
        belief = filter.predict(belief, u, 0.004 * k, 0.004)
        truth = model.transition(x, u, 0.0, 0.004 * (k + 1))
        channels = ("gyro", "wrist_quat") if k % 2 else ("attitude",)
        y = -model.measurement(truth, u, 0.0, channels)
        if k % 2:
            y[:, :3] *= -1
        belief, _ = filter.update(belief, y, u, 0.0, channels)
    assert not belief.fault.any()
    np.testing.assert_array_equal(np.isfinite(belief.variance[0]), [False] + [True] * 9)
    assert np.abs(model.space.minus(belief.mean, truth)).max() < 0.1


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"adapt": "S"}, EstimatorError, "AdaptiveEKF: adapt is 'S'; use one of none, R, Q, both"),
        ({"window": 1}, EstimatorError, "AdaptiveEKF: window is 1; use an integer of at least 2"),
        ({"fading": 0.9}, EstimatorError, "AdaptiveEKF: fading is 0.9"),
        ({"inflation": {"x0": 0.5}}, EstimatorError, "AdaptiveEKF: inflation is .* at least 1"),
        ({"pseudo_noise": -1.0}, EstimatorError, "AdaptiveEKF: pseudo_noise is -1.0"),
        ({"pseudo_noise": {"q*": 1}}, ScenarioError, "AdaptiveEKF: pseudo_noise: .* matches none"),
    ],
)
def test_wrong_settings_say_so(settings, error, words):
    with pytest.raises(error, match=words):
        AdaptiveEKF(linear_model(0), **settings)
