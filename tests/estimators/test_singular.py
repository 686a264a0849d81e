"""P that is singular with good reason, and P that is much larger than R."""

from fractions import Fraction

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.estimators.beliefs import Fault
from estbench.models.linear import LinearModel
from tests.helpers import EXACT, OTHER, SAMPLED
from tests.textbook import exact_filter

SETTINGS = [(name, {}) for name in EXACT if not hasattr(registry.resolve(name), "smooth")] + [
    ("ukf", {"redraw": False}),
    ("ukf", {"alpha": 0.5}),
    ("ckf", {"redraw": False}),
    ("sr_ukf", {"alpha": 0.5}),
    ("adaptive_ekf", {"adapt": "none"}),
    ("imm", {"process_noise_scales": [1.0]}),
]
IDS = ["-".join([n, *map(str, s.values())]) for n, s in SETTINGS]
# Position, velocity, a fast lag and a constant, which is known; the first two are one at the start.
A = np.array([[1, 0.125, 0, 0.5], [0, 1, 0.125, 0], [0, 0, 0.25, 0], [0, 0, 0, 1]])
C = np.array([[1.0, 0.0, 0.0, 0.0]])
Q, R = np.diag([0.0, 0.01, 0.0, 0.0]), np.eye(1) / 64
P0 = np.array([[1.0, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0.25, 0], [0, 0, 0, 0]])
TREND = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])


def run(name, settings, model, x, P, ys):
    filter = registry.create(name, settings, model)
    belief, u = filter.init(x[None], P[None]), np.zeros((1, 0))
    for k, y in enumerate(ys):
        belief = filter.predict(belief, u, float(k), 1.0)
        belief, _ = filter.update(belief, y[None], u, k + 1.0)
    return belief, filter.mean(belief)[0], filter.cov(belief)[0]


@pytest.mark.parametrize(("name", "settings"), SETTINGS, ids=IDS)
def test_a_singular_covariance_is_that_of_exact_arithmetic(name, settings):
    x, ys = np.array([0.0, 0.0, 0.5, 3.0]), np.random.default_rng(0).normal(size=(30, 1))
    mean, cov = exact_filter(A, C, Q, R, x, P0, ys)[-1]
    belief, m, P = run(name, settings, LinearModel(A, C, Q, R), x, P0, ys)
    assert not belief.fault.any()
    np.testing.assert_allclose(m, mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(P, cov, rtol=1e-10, atol=1e-10)
    assert m[3] == 3.0
    np.testing.assert_array_equal(P[3], 0.0)  # known exactly, and it stays so


@pytest.mark.parametrize("name", ["enkf", "pf", "robust_ekf", "imm", "adaptive_ekf"])
def test_others_keep_what_is_known_exactly(name):
    assert name in SAMPLED | OTHER
    ys = 0.1 * np.random.default_rng(0).normal(size=(5, 1)) + 1.5 * np.arange(1, 6)[:, None]
    belief, m, P = run(name, {}, LinearModel(A, C, Q, R), np.array([0, 0, 0.5, 3]), P0, ys)
    assert not belief.fault.any()
    assert m[3] == pytest.approx(3.0, rel=1e-12)
    np.testing.assert_allclose(P[3], 0.0, atol=1e-14)


@pytest.mark.parametrize("ratio", [1e18, 1e24])
@pytest.mark.parametrize("name", ["ekf", "kf", "iekf", "sr_ekf", "ukf", "sr_ukf", "ckf", "ghkf"])
def test_a_linear_trend_from_a_diffuse_prior(name, ratio):
    """Q is as large as what a covariance of numbers as large as P₀ loses to rounding."""
    noise, prior = 1e2 / np.sqrt(ratio) * np.eye(1), 1e-2 * np.sqrt(ratio) * np.eye(2)
    ys = 1e-3 * np.random.default_rng(0).normal(size=(50, 1))
    Q = np.diag([0.0, 1e-8])
    mean, cov = exact_filter(*TREND, Q, noise, np.zeros(2), prior, ys)[-1]
    belief, m, P = run(name, {}, LinearModel(*TREND, Q, noise), np.zeros(2), prior, ys)
    assert not belief.fault.any()
    np.testing.assert_allclose(m, mean, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(P, cov, rtol=1e-6)


@pytest.mark.parametrize("name", ["sr_ekf", "sr_ukf"])
def test_a_square_root_filter_has_its_digits_at_once(name):
    """Three readings after a prior of 1e18 R, no Q: the fit of a line."""
    ys = np.array([[0.5], [-0.25], [0.75]])
    model = LinearModel(*TREND, np.zeros((2, 2)), np.eye(1))
    mean, cov = exact_filter(*TREND, model.Q, model.R, np.zeros(2), 1e18 * np.eye(2), ys)[-1]
    _, m, P = run(name, {}, model, np.zeros(2), 1e18 * np.eye(2), ys)
    np.testing.assert_allclose(m, mean, rtol=1e-6)
    np.testing.assert_allclose(P, cov, rtol=1e-6)
    np.testing.assert_allclose(P, [[5 / 6, 1 / 2], [1 / 2, 1 / 2]], rtol=1e-6)


@pytest.mark.parametrize("name", ["ukf", "sr_ukf", "ckf", "ghkf", "sr_ekf", "enkf"])
def test_an_indefinite_covariance_stays_a_fault(name):
    model = LinearModel(A, C, Q, R)
    filter = registry.create(name, {}, model)
    cov = np.stack([P0, P0 - np.diag([0, 0, 0, 1e-3]), np.diag([1e12, 1, 1, -1.0])])
    belief = filter.init(np.zeros((3, 4)), cov)
    belief = filter.predict(belief, np.zeros((3, 0)), 0.0, 1.0)
    assert belief.fault.tolist() == [Fault.NONE, Fault.COVARIANCE, Fault.COVARIANCE]


def test_exact_arithmetic_is_exact():
    """The textbook of these tests against a scalar by hand: P = 1/(1/4 + 1) after y = 5."""
    one = np.eye(1)
    ((mean, cov),) = exact_filter(one, one, 0 * one, one, np.zeros(1), 4 * one, np.array([[5.0]]))
    assert cov[0, 0] == float(Fraction(4, 5))
    assert mean[0] == 4.0
