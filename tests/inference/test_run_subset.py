"""A run pays for its own late readings, not for its neighbours'."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.estimators.beliefs import Gaussian
from estbench.experiment import setup
from estbench.inference import run_subset as partial
from estbench.inference.event_loop import run_filter
from estbench.inference.fusion import Delays
from estbench.montecarlo import run as experiment
from estbench.robots.library import engine
from estbench.simulation.sources import Recorded, Trajectory
from tests.helpers import simulated

RUNS = 64


def gaussian(runs):
    mean = np.arange(2.0 * runs).reshape(runs, 2)
    return Gaussian(mean, np.tile(np.eye(2), (runs, 1, 1)), np.zeros(runs, np.uint8))


@dataclass(frozen=True)
class Shared(Gaussian):
    """A belief with a number that all runs share."""

    gain: Any = 1.0


def test_few_rows_are_taken_and_their_count_is_a_power_of_two():
    chosen = np.zeros(RUNS, bool)
    for rows, count in ([3], 1), ([3, 9], 2), ([0, 5, 63], 4), (list(range(9)), 16):
        chosen[:] = False
        chosen[rows] = True
        found = partial.some(gaussian(RUNS), chosen)
        assert isinstance(found, np.ndarray)
        assert (len(found), set(found.tolist())) == (count, set(rows))
    assert not len(partial.some(gaussian(RUNS), np.zeros(RUNS, bool))[:])


def test_all_rows_are_taken_where_they_are_many_or_the_belief_is_one():
    chosen = np.arange(RUNS) < 33
    assert partial.some(gaussian(RUNS), chosen) == partial.ALL
    few = np.arange(RUNS) < 3
    shared = Shared(*(getattr(gaussian(RUNS), name) for name in ("mean", "cov", "fault")))
    for belief in (shared, (np.zeros((RUNS, 2)),), {"mean": np.zeros(RUNS)}):
        assert partial.some(belief, few) == partial.ALL


def test_what_was_taken_is_put_back():
    whole, rows = gaussian(6), np.array([4, 1, 4])
    part = partial.take(whole, rows)
    np.testing.assert_array_equal(part.mean, whole.mean[[4, 1, 4]])
    changed = partial.put(whole, rows, replace(part, mean=-part.mean))
    np.testing.assert_array_equal(changed.mean[[1, 4]], -whole.mean[[1, 4]])
    np.testing.assert_array_equal(changed.mean[[0, 2, 3, 5]], whole.mean[[0, 2, 3, 5]])
    np.testing.assert_array_equal(whole.mean, gaussian(6).mean)  # beliefs are values
    assert partial.take(whole, partial.ALL) is whole
    assert partial.put(whole, partial.ALL, part) is part
    np.testing.assert_array_equal(partial.within(rows, np.array([1, 0])), [1, 4])


# In the event loop


class Watched:
    """An estimator that counts the rows it works on; its beliefs can be divided, or not."""

    def __init__(self, inner, divisible):
        self.inner, self.divisible, self.predicted, self.updated = inner, divisible, 0, 0

    def _out(self, belief):
        return belief if self.divisible else (belief,)

    def _in(self, belief):
        return belief if self.divisible else belief[0]

    def init(self, mean, cov):
        return self._out(self.inner.init(mean, cov))

    def predict(self, belief, u, t, dt):
        self.predicted += len(u)
        return self._out(self.inner.predict(self._in(belief), u, t, dt))

    def update(self, belief, y, u, t, channels=None, mask=None):
        self.updated += len(y)
        belief, innovation = self.inner.update(self._in(belief), y, u, t, channels, mask)
        return self._out(belief), innovation

    def mean(self, belief):
        return self.inner.mean(self._in(belief))

    def cov(self, belief):
        return self.inner.cov(self._in(belief))


@cache
def recorded():
    """A trajectory of which a reading in twenty comes 1 to 9 steps late; predicts that it asks."""
    prepared = setup.build(experiment.resolve("cartpole_imu", duration=0.4))
    trajectory = simulated(prepared, RUNS)
    count, rng = len(trajectory.deliveries), np.random.default_rng(1)
    deliveries: list[list[Any]] = [[] for _ in range(count)]
    depth = np.zeros((count, RUNS), int)
    for k, arrived in enumerate(trajectory.deliveries):
        for d in arrived:
            late = np.where(rng.random(RUNS) < 0.05, rng.integers(1, 10, RUNS), 0)
            for steps in np.unique(late):
                if k + steps < count:
                    deliveries[k + steps].append(d._replace(mask=late == steps))
                    depth[k + steps] = np.maximum(depth[k + steps], steps * (late == steps))
    asked = int(np.maximum(depth - 1, 0).sum())
    return prepared, Trajectory(trajectory.x, trajectory.u, deliveries), asked


def run(kind, divisible, **delays) -> Any:
    prepared, trajectory, _ = recorded()
    watched = Watched(registry.create(kind, {}, prepared.model()), divisible)
    prior = np.tile(prepared.mean, (RUNS, 1)), np.tile(prepared.cov, (RUNS, 1, 1))
    with engine():
        traces = run_filter(
            watched, prepared.space, prior, Recorded(prepared.instants, trajectory),
            prepared.channel_spaces, keep_cov=True, delays=Delays(**delays),
        )  # fmt: skip
    return watched, traces


@pytest.mark.parametrize("kind", ["ekf", "ukf", "sr_ukf"])
@pytest.mark.parametrize("delays", [{"window": 12}, {"window": 4}, {"handling": "naive"}], ids=str)
def test_working_on_some_runs_is_working_on_all(kind, delays):
    (few, one), (many, all_) = run(kind, True, **delays), run(kind, False, **delays)
    assert few.updated < many.updated
    np.testing.assert_allclose(one.mean, all_.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.cov, all_.cov, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.nis, all_.nis, rtol=1e-6)
    np.testing.assert_array_equal(one.dof, all_.dof)
    np.testing.assert_array_equal(one.late, all_.late)
    np.testing.assert_allclose(one.lags, all_.lags, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(one.lag_terms, all_.lag_terms)


def test_a_late_reading_costs_the_predicts_of_its_own_run():
    """d - 1 a late arrival, at most twice that as counts are rounded up to powers of two."""
    prepared, _, asked = recorded()
    steps = len(prepared.instants) * RUNS
    few, many = (run("ekf", divisible, window=12)[0] for divisible in (True, False))
    assert 0 < asked < few.predicted - steps < 2 * asked
    assert many.predicted - steps > 4 * asked
