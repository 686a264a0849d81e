"""Smoothers from singular and from diffuse priors, against exact answers."""

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.following import follow
from estbench.models.linear import LinearModel
from tests.textbook import exact_smoother

A, C = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
YS = np.random.default_rng(0).normal(size=(20, 1, 1))
NOISES = {
    "constant": np.zeros((2, 2)),
    "walk": np.diag([0.0, 0.01]),
    "acceleration": 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]),
}
SMOOTHERS = [
    ("rts", {}),
    ("rts", {"base": "ekf"}),
    ("urts", {}),
    ("urts", {"base": "ukf"}),
    ("urts", {"base": "ckf"}),
    ("map", {}),
]
IDS = ["-".join([n, *s.values()]) for n, s in SMOOTHERS]


def smooth(name, settings, model, mean, cov, ys=YS):
    estimator = registry.create(name, settings, model)
    beliefs = estimator.smooth(follow(estimator, mean[None], cov[None], ys))
    assert not np.any([b.fault for b in beliefs])
    return [(estimator.mean(b)[0], estimator.cov(b)[0]) for b in beliefs]


@pytest.mark.parametrize(("name", "settings"), SMOOTHERS, ids=IDS)
def test_an_exactly_known_coordinate_without_process_noise(name, settings):
    """A line through 0, fitted to y: slope Σ k yₖ/(1 + Σ k²) with the prior N(0, 1)."""
    model = LinearModel(A, C, np.zeros((2, 2)), np.eye(1))
    k = np.arange(1, 21.0)
    slope, variance = k @ YS[:, 0, 0] / (1 + k @ k), 1 / (1 + k @ k)
    for i, (mean, cov) in enumerate(smooth(name, settings, model, np.zeros(2), np.diag([0.0, 1]))):
        np.testing.assert_allclose(mean, [i * slope, slope], rtol=1e-8, atol=1e-10)
        expected = variance * np.array([[i * i, i], [i, 1.0]])
        np.testing.assert_allclose(cov, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("size", [1.0, 1e6, 1e12, 1e16, 1e18])
@pytest.mark.parametrize("name", ["rts", "urts", "map"])
def test_a_diffuse_prior(name, size, noise):
    """Relative to σ and to the variances; 1e-7 of the filter's σ at 1e18 is 1e2 in units of R."""
    Q = NOISES[noise]
    exact = exact_smoother(A, C, Q, np.eye(1), np.zeros(2), size * np.eye(2), YS[:, 0])
    found = smooth(name, {}, LinearModel(A, C, Q, np.eye(1)), np.zeros(2), size * np.eye(2))
    for (mean, cov), (m, P) in zip(found, exact):
        std = np.sqrt(np.diag(P))
        np.testing.assert_allclose(mean / std, m / std, atol=1e-6)
        np.testing.assert_allclose(cov / np.outer(std, std), P / np.outer(std, std), atol=1e-6)


@pytest.mark.parametrize(("name", "settings"), SMOOTHERS, ids=IDS)
def test_a_fast_lag_is_not_amplified_backwards(name, settings):
    """x₂⁺ = 0.1 x₂ + 0.3 settles at 1/3; 1/0.1 per step would make rounding errors large."""
    F = np.array([[1.0, 0.1, 0.1], [0.0, 1.0, 0.2], [0.0, 0.0, 0.1]])
    model = LinearModel(F, np.array([[1.0, 0, 0]]), np.diag([0, 0.01, 0]), np.eye(1), B=np.eye(3))
    estimator = registry.create(name, settings, model)
    u = np.broadcast_to([0.0, 0.0, 0.3], (60, 1, 3))
    ys = np.random.default_rng(1).normal(size=(60, 1, 1))
    history = follow(estimator, np.zeros((1, 3)), np.diag([1.0, 1.0, 0.04])[None], ys, u=u)
    beliefs = estimator.smooth(history)
    means = np.array([estimator.mean(b)[0] for b in beliefs])
    covs = np.array([estimator.cov(b)[0] for b in beliefs])
    assert np.isfinite(covs).all()
    first = means[0, 2]
    lag = np.array([first * 0.1**k + (1 - 0.1**k) / 3 for k in range(61)])
    np.testing.assert_allclose(means[:, 2], lag, atol=1e-9)
    assert np.linalg.eigvalsh(covs).min() > -1e-12
