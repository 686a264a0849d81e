"""Suites against the Kalman filter, the linear budget and Monte Carlo runs."""

import numpy as np
import pytest

import estbench
from estbench.bounds.expectation import Reading
from estbench.bounds.linearization import Linearization
from estbench.budgets.linear import linear
from estbench.errors import ScenarioError
from estbench.estimators.ekf import EKF
from estbench.experiment.setup import build
from estbench.scenario.load import resolve
from estbench.suites.along import Motion
from estbench.suites.covariance import Course
from estbench.suites.design import of_setup
from tests.helpers import linear_model, random_cov

REQUIRED = "hinge=0.01"


def test_the_recursion_is_the_kalman_filters():
    """Many suites at once: with the weight 2 the noise is half, with 0 there is no reading."""
    model, rng, steps = linear_model(3), np.random.default_rng(0), 12
    root = np.linalg.cholesky(random_cov(rng, 3))
    x, u = np.zeros((steps + 1, 1, 3)), np.zeros((steps, 1, 1))
    read = [Reading(k, k) for k in range(1, steps + 1)]
    times = 0.1 * np.arange(steps + 1)
    motion = Motion(
        Linearization(model), model.space.names, model.space.units, root, times, x, u, read
    )
    shown = Course.of(motion).shown([{"": 1.0}, {"": 2.0}, {}])
    for i, weight in enumerate((1.0, 2.0, 0.0)):
        ekf = EKF(model if not weight else type(model)(
            model.A, model.C, model.Q, model.R / weight**2, model.B, model.D))  # fmt: skip
        belief = ekf.init(np.zeros((1, 3)), (root @ root.T)[None])
        variances, nats = [], 0.0
        for k in range(steps):
            belief = ekf.predict(belief, u[k], 0.1 * k, 0.1)
            if weight:
                S = model.C @ belief.cov[0] @ model.C.T + model.R / weight**2
                nats += 0.5 * np.linalg.slogdet(np.linalg.solve(model.R / weight**2, S))[1]
                belief, _ = ekf.update(belief, np.zeros((1, 2)), u[k], 0.1 * (k + 1))
            variances.append(np.diag(belief.cov[0]))
        np.testing.assert_allclose(shown.mse[i], np.mean(variances, axis=0), rtol=1e-10)
        np.testing.assert_allclose(shown.information[i], nats, rtol=1e-10)


def test_what_all_channels_reach_is_what_the_filter_reaches():
    """Against the covariance of a matched EKF, to 2%."""
    prepared = build(resolve("quadrotor", ["ekf"], duration=0.4))
    found = of_setup(prepared, {"root.x": 0.2})
    believed = linear(prepared, "ekf", 1).believed[1:].mean(axis=0)
    np.testing.assert_allclose(found.all, np.sqrt(believed), rtol=0.02)
    for change, by_channel in found.changed.items():
        for std in by_channel.values():
            better = std <= found.all * (1 + 1e-9)
            assert (better if change != "without" else std >= found.all * (1 - 1e-9)).all()
    assert (np.diff(found.information) >= 0).all()


def test_a_suite_is_chosen_by_cost_and_confirmed():
    """The prediction is within 10% of 60 runs; these have an interval of about 6%."""
    options = {"duration": 1.0, "overrides": ["consistency.burn_in=0.2"]}
    found = estbench.design("pendulum", REQUIRED, "ekf", runs=60, workers=1, **options)
    assert found.chosen == ("encoder",)
    assert found.exhaustive
    assert found.total_cost == 1.0
    assert found.verdict in ("consistent", "undecided")
    assert found.rmse is not None
    for predicted, reached in zip(found.std, found.rmse):
        assert reached.low < 1.1 * predicted
        assert reached.high > predicted / 1.1
    assert found.std[0] <= 0.01
    dear = [*options["overrides"], "channels.encoder.cost=5.0"]
    other = estbench.design("pendulum", "hinge=0.03", runs=0, duration=1.0, overrides=dear)
    assert other.chosen == ("gyro",)
    fixed = estbench.design("pendulum", REQUIRED, channels=["gyro"], runs=0, duration=1.0)
    assert fixed.always == ("encoder",)
    assert fixed.chosen == ("encoder",)


def test_bad_input():
    for require, options, message in (
        ("hinge=1e-6", {}, r"no suite of the channels reaches hinge = 1e-06 rad \(all reach"),
        ("hing=0.1", {}, "'hing' matches none"),
        ("hinge=-1", {}, "hinge is -1; a σ is a number above 0"),
        ("hinge", {}, "is no requirement; use COORDINATE=SIGMA"),
        ({}, {}, "--require is empty"),
        (REQUIRED, {"channels": ["giro"]}, "'giro' matches no channel"),
        (REQUIRED, {"overrides": ["channels.gyro.cost=-1.0"]}, "greater than or equal to 0"),
        (REQUIRED, {"runs": -1}, "--runs -1"),
    ):
        with pytest.raises(ScenarioError, match=message):
            estbench.design("pendulum", require, duration=0.1, **{"runs": 0, **options})
