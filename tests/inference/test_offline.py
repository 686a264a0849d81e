"""Through given measurements an estimator goes the way the event loop takes it."""

import numpy as np
import pytest

from estbench.errors import DimensionError
from estbench.estimators import registry
from estbench.inference.event_loop import run_filter
from estbench.inference.offline import follow
from estbench.sensors.sampling import Delivery
from estbench.sensors.timing import Instant
from estbench.simulation.sources import Recorded, Trajectory
from estbench.smoothers.rts import rts
from tests.helpers import nonlinear_model, random_cov

RUNS, STEPS = 5, 12
TIMES = np.array([0.0, 0.1, 0.15, *np.arange(2, STEPS) * 0.1 + 0.05])


def given(seed=0):
    """A model, prior, controls, and what was measured."""
    rng = np.random.default_rng(seed)
    model = nonlinear_model()
    mean, cov = 0.3 * rng.standard_normal((RUNS, 2)), random_cov(rng, 2, RUNS, 0.05)
    u = rng.standard_normal((STEPS, RUNS, 1))
    reference = model.measurement(mean, u[0])
    y = reference + 0.05 * rng.standard_normal((STEPS, RUNS, reference.shape[-1]))
    return model, mean, cov, u, y


@pytest.mark.parametrize("name", ["ekf", "ukf", "sr_ekf", "pf", "rts", "urts", "map"])
def test_the_beliefs_are_those_of_the_event_loop(name):
    model, mean, cov, u, y = given()
    missing = np.zeros((STEPS, RUNS), bool)
    missing[3], missing[5, 1], missing[-1, [0, 4]] = True, True, True
    y[missing] = np.nan
    keys = np.arange(7, 7 + RUNS, dtype=np.uint64)
    instants = [
        Instant(*TIMES[k : k + 2].tolist(), 1, ("radar",), True, k + 1) for k in range(STEPS)
    ]
    readings = [
        [] if missing[k].all() else [Delivery(("radar",), k + 1, y[k], ~missing[k], k + 1)]
        for k in range(STEPS)
    ]
    source = Recorded(instants, Trajectory(np.zeros((STEPS + 1, RUNS, 2)), u, readings))
    expected = run_filter(
        registry.create(name, {}, model), model.space, (mean, cov), source,
        {"radar": model.output()}, keys=keys, keep_cov=True,
    )  # fmt: skip
    assert expected is not None
    assert expected.cov is not None
    estimator = registry.create(name, {}, model)
    history = follow(estimator, mean, cov, y, u=u, times=TIMES, keys=keys)
    beliefs = estimator.smooth(history) if hasattr(estimator, "smooth") else history.beliefs
    for k, belief in enumerate(beliefs):
        np.testing.assert_allclose(estimator.mean(belief), expected.mean[k], rtol=0, atol=1e-12)
        np.testing.assert_allclose(estimator.cov(belief), expected.cov[k], rtol=0, atol=1e-12)


def test_one_component_may_be_missing_and_time_is_counted_in_steps():
    model, mean, cov, _, y = given(1)
    y[:, :, 0] = np.nan
    ekf = registry.create("ekf", {}, model)
    history = follow(ekf, mean, cov, y)
    belief, still = ekf.init(mean, cov), np.zeros((RUNS, 1))
    mask = np.broadcast_to([False] + [True] * (y.shape[-1] - 1), y[0].shape)
    for k in range(STEPS):
        belief = ekf.predict(belief, still, float(k), 1.0)
        belief, _ = ekf.update(belief, np.nan_to_num(y[k]), still, k + 1.0, None, mask)
        np.testing.assert_allclose(history.beliefs[k + 1].mean, belief.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(history.beliefs[k + 1].cov, belief.cov, rtol=0, atol=1e-12)
    smoothed = rts(model, history.beliefs, history.controls, history.times)
    assert np.isfinite([b.mean for b in smoothed]).all()


@pytest.mark.parametrize("given_u", [False, True])
def test_an_estimator_that_shows_no_model_is_given_what_was_measured(given_u):
    model, mean, cov, u, y = given(2)
    ekf, still = registry.create("ekf", {}, model), np.zeros((RUNS, 1))
    seen = []

    class Own:
        def __init__(self):
            self.init, self.mean, self.cov = ekf.init, ekf.mean, ekf.cov

        def predict(self, belief, held, t, dt):
            seen.append(held.shape)
            return ekf.predict(belief, held if given_u else still, t, dt)

        def update(self, belief, measured, held, *more):
            seen.append(held.shape)
            return ekf.update(belief, measured, held if given_u else still, *more)

    found = follow(Own(), mean, cov, y, u=u if given_u else None)
    assert set(seen) == {(RUNS, 1 if given_u else 0)}
    expected = follow(ekf, mean, cov, y, u=u if given_u else None)
    np.testing.assert_array_equal(found.beliefs[-1].mean, expected.beliefs[-1].mean)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"y": np.zeros((STEPS, 2))}, r"y has shape \(12, 2\); expected \(step, 5, 2\)"),
        ({"y": np.zeros((STEPS, RUNS, 3))}, r"y has shape \(12, 5, 3\); expected \(step, 5, 2\)"),
        ({"u": np.zeros((STEPS - 1, RUNS, 1))}, r"u has shape \(11, 5, 1\); expected \(12, 5, 1\)"),
        ({"times": np.arange(STEPS)}, r"times has shape \(12,\); expected 13 rising numbers"),
        ({"times": np.zeros(STEPS + 1)}, "13 rising numbers"),
    ],
)
def test_what_does_not_fit_is_named(changes, message):
    model, mean, cov, u, y = given()
    arguments = {"y": y, "u": u} | changes
    with pytest.raises(DimensionError, match=message):
        follow(registry.create("ekf", {}, model), mean, cov, arguments.pop("y"), **arguments)
