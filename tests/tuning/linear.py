"""A random walk that is measured: x⁺ = x + w, y = x + v; its likelihood in five lines."""

import numpy as np

from estbench.estimators.kf import KF
from estbench.models.linear import LinearModel
from estbench.tuning.given import Given
from estbench.tuning.parameters import Parameter

STEPS, RUNS = 30, 12
TRUE = (0.3, 0.5)
"""Variances of w and v."""


def model(values):
    q, r = values
    one = np.eye(1)
    return LinearModel(one, one, q * one, r * one)


def readings(seed=0, runs=RUNS, steps=STEPS, true=TRUE):
    """Measurements `(step, run, 1)`; the start has mean 0 and variance 1."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((1, runs, 1))
    w = np.sqrt(true[0]) * rng.standard_normal((steps, runs, 1))
    return x + w.cumsum(axis=0) + np.sqrt(true[1]) * rng.standard_normal((steps, runs, 1))


def prior(runs=RUNS):
    return np.zeros((runs, 1)), np.ones((runs, 1, 1))


def given(y, make=lambda values: KF(model(values))):
    return Given(make, *prior(y.shape[1]), y)


def dense(y, values):
    """Minus the log-likelihood per run, from the joint covariance of all readings."""
    q, r = values
    k = np.arange(1, len(y) + 1)
    S = 1.0 + q * np.minimum.outer(k, k) + r * np.eye(len(y))
    fit = np.einsum("ki,kl,li->i", y[..., 0], np.linalg.inv(S), y[..., 0])
    return 0.5 * (fit + np.linalg.slogdet(2 * np.pi * S)[1])


def parameters(start=(30.0, 0.005), factor=1e4, names=("q", "r")):
    return tuple(Parameter((n,), n, s, s / factor, s * factor, True) for n, s in zip(names, start))
