"""A disturbance's square root, its density and the filter's Q say the same, scaled or over time."""

import numpy as np
import pytest

from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.robots.disturbance import Disturbance
from estbench.robots.layout import state_space
from estbench.robots.model import MujocoModel
from tests.helpers import random_states, zoo_model

KINDS = ("additive", "force", "actuator")
SCALE = 9.0


def matrix(size):
    """A covariance `(size, size)` of full rank with correlations."""
    a = np.random.default_rng(size).standard_normal((size, size))
    return a @ a.T / size + 0.1 * np.eye(size)


def disturbance(kind, schedule):
    """The disturbance, and its Q_s at time t as a function."""
    model = zoo_model("joints")
    space = state_space(model)
    size = {"additive": space.n, "force": model.nv, "actuator": model.nu}[kind]
    Q = matrix(size)
    built = Disturbance.build(model, space, kind, matrix=Q.tolist())
    std = np.linspace(1.0, 2.0, size)
    if schedule == "factor":
        return built.scheduled(lambda t: 1.0 + t), lambda t: (1.0 + t) * Q
    if schedule == "factors":
        return built.scheduled(
            lambda t: std**2 + t
        ), lambda t: Q * np.outer(np.sqrt(std**2 + t), np.sqrt(std**2 + t))
    if schedule == "matrix":
        return built.scheduled(lambda t: Q + t * np.eye(size)), lambda t: Q + t * np.eye(size)
    return built, lambda t: Q


@pytest.mark.parametrize("schedule", ["constant", "factor", "factors", "matrix"])
@pytest.mark.parametrize("kind", KINDS)
def test_root_sample_and_covariance_of_a_scaled_disturbance(kind, schedule):
    plain, Q = disturbance(kind, schedule)
    scaled, twice = plain.scaled(SCALE), plain.scaled(2.0).scaled(SCALE / 2.0)
    raw = zoo_model("joints")
    x, u = random_states(raw, 2, scale=0.1)
    dt = raw.opt.timestep
    size = np.sqrt(dt) if kind == "additive" else np.sqrt(1.0 / dt)
    models = [MujocoModel(raw, [], d) for d in (plain, scaled, twice)]
    for t in (0.0, 0.7):
        for given, factor in ((plain, 1.0), (scaled, SCALE), (twice, SCALE)):
            root = given.root(t)
            np.testing.assert_allclose(root @ root.T, factor * Q(t), rtol=1e-12, atol=1e-12)
            w = given.sample(np.eye(given.rank), t, dt)
            np.testing.assert_allclose(w.T @ w, factor * size**2 * Q(t), rtol=1e-12, atol=1e-12)
        for name, interval in (("process_noise", [dt]), ("spectral_density", [])):
            one, other, third = (getattr(m, name)(x, u, t, *interval) for m in models)
            # The response to a force or a control is not quite linear in its size.
            np.testing.assert_allclose(other, SCALE * one, rtol=1e-3, atol=1e-3 * np.abs(one).max())
            np.testing.assert_allclose(third, other, rtol=1e-9, atol=1e-12)
            if kind == "additive":
                np.testing.assert_allclose(one, Q(t) * np.prod(interval), rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_the_filters_q_is_the_true_one_times_the_scale(kind):
    noise = f"process_noise={{kind='{kind}', density=0.01}}"
    plain, scaled = (
        setup.build(experiment.resolve("cartpole", overrides=[noise, *more])).model()
        for more in ((), (f"filter.process_noise_scale={SCALE}",))
    )
    x, u = np.tile([0.1, 0.2, 0.0, 0.3], (2, 1)), np.zeros((2, 1))
    for name, arguments in (("process_noise", (0.3, 0.01)), ("spectral_density", (0.3,))):
        one, other = (getattr(m, name)(x, u, *arguments) for m in (plain, scaled))
        np.testing.assert_allclose(other, SCALE * one, rtol=1e-4, atol=1e-12)
