"""Rows of a filter that begin at different times say what each of their runs says alone."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest

from estbench.errors import EstimatorError
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.inference.live import LiveFilter
from estbench.montecarlo import run as experiment
from estbench.randomness import streams
from tests.helpers import ESTIMATORS, SAMPLED, Fleet

PERIODS = 16
BEGINNINGS = {
    0: ([0, 1, 2, 3], [0, 1, 2, 3]), 4: ([1], [4]), 6: ([3, 0], [5, 6]), 7: ([1], [2]),
    11: ([0, 1, 2], [7, 8, 9]), 13: ([2], [1]),
}  # fmt: skip
LATE = (
    "channels.cart_encoder.latency=0.03", "channels.cart_encoder.latency_std=0.02",
    "channels.pole_encoder.rate=50", "channels.pole_encoder.dropout=0.2", "filter.window=0.04",
)  # fmt: skip
SCHEDULED = (
    "channels.pole_encoder.schedule=[[0.04, 1.0], [0.08, 4.0], [9.0, 2.0]]",
    "process_noise.schedule=[[0.05, 1.0], [9.0, 5.0]]",
)
SETTINGS = {"imm": {"models": [{}, {"body_mass.pole": 0.2}]}}


class Clocked(EKF):
    """A user's estimator that takes its sensors to drift."""

    def update(self, belief, y, u, t, channels=None, mask=None):
        return super().update(belief, y + 0.1 * t, u, t, channels, mask)


class Boxed:
    """A user's estimator whose belief is an object that nobody can take apart by rows."""

    def __init__(self, model):
        self.ekf = EKF(model)

    def init(self, mean, cov):
        return Box(self.ekf.init(mean, cov))

    def predict(self, belief, u, t, dt):
        return Box(self.ekf.predict(belief.inner, u, t, dt))

    def update(self, belief, *arguments, **options):
        inner, innovation = self.ekf.update(belief.inner, *arguments, **options)
        return Box(inner), innovation

    def mean(self, belief):
        return self.ekf.mean(belief.inner)

    def cov(self, belief):
        return self.ekf.cov(belief.inner)


class Box:
    def __init__(self, inner):
        self.inner = inner


@cache
def prepare(overrides, settings=None):
    table: dict[str, Any] = {"f": dict(settings or {"type": "ekf"})}
    scenario = experiment.resolve("cartpole", duration=0.3, overrides=overrides)
    return setup.build(scenario.model_copy(update={"estimators": table}))


def follow(fleet, estimator, by_clock, periods=PERIODS):
    """(row, run, what is said of it) of each row after each of its control periods."""
    prepared = fleet.prepared
    live = LiveFilter(
        estimator, prepared.space, prepared.channel_spaces, fleet.rows, prepared.delays("f"),
        by_clock=by_clock,
    )  # fmt: skip
    mean, cov = (np.repeat(a[None], fleet.rows, axis=0) for a in prepared.prior("f"))
    for period in range(periods):
        began = fleet.begin(period)
        if began is not None:
            rows, runs = began
            keys = np.zeros(fleet.rows, np.uint64)
            keys[rows] = streams.run_keys(0, runs.tolist(), "estimator:f")
            live.start(rows, mean, cov, keys)
            np.testing.assert_array_equal(live.estimate[rows], mean[rows])
            assert not live.dof[rows].any()
        live.begin()
        for event, u, arrived in fleet.period():
            live.step(event, u, arrived)
        live.settle()
        info = live.info(fleet.simulator.x)
        elapsed = fleet.elapsed
        for row in range(fleet.rows):
            said = {name: value[row] for name, value in info.items()}
            yield row, int(fleet.runs[row]), int(elapsed[row]), said | {"cov": live.cov[row]}


def assert_alone(prepared, make, by_clock=False, atol=1e-8, beginnings=BEGINNINGS, rows=4):
    """Each row is its run alone; returns what was compared."""
    fleet = Fleet(prepared, rows, beginnings, timed=by_clock)
    alone: dict[int, dict[int, Any]] = {}
    out = []
    for row, run, elapsed, said in follow(fleet, make(), by_clock):
        if run not in alone:
            single = follow(Fleet.alone(prepared, run), make(), by_clock)
            alone[run] = {e: s for _, _, e, s in single}
        expected, where = alone[run][elapsed], f"row {row}, run {run}, period {elapsed}"
        np.testing.assert_array_equal(said["truth"], expected["truth"], where)
        for name, value in said.items():
            loose = name in ("nis", "nees")
            np.testing.assert_allclose(
                value, expected[name], rtol=1e-5 if loose else 0, atol=1e-5 if loose else atol,
                err_msg=f"{name}, {where}",
            )  # fmt: skip
        out.append(said)
    return out


@pytest.mark.parametrize("overrides", [(), LATE], ids=["on time", "late"])
@pytest.mark.parametrize("kind", [k for k in ESTIMATORS if k not in ("rts", "urts", "map")])
def test_every_estimator_begins_anew_row_by_row(kind, overrides):
    prepared = prepare(overrides, settings(kind))
    if overrides and kind in SAMPLED:
        pytest.skip("where readings miss in some rows, its random numbers are those of the batch")
    said = assert_alone(prepared, lambda: prepared.estimator("f"))
    assert np.sum([s["nis_dof"] for s in said]) > 40


def settings(kind):
    return HashableDict(SETTINGS.get(kind, {}) | {"type": kind})


class HashableDict(dict):
    def __hash__(self):
        return hash(str(self))


@pytest.mark.parametrize("overrides", [(), LATE], ids=["on time", "late"])
def test_a_belief_that_cannot_be_divided_is_computed_with_those_that_began_together(overrides):
    prepared = prepare(overrides)
    assert_alone(prepared, lambda: Boxed(prepared.model()))


@pytest.mark.parametrize("overrides", [(), LATE], ids=["on time", "late"])
@pytest.mark.parametrize("method", ["batch", "static"])
def test_a_start_that_fits_the_first_readings_is_a_rows_own(method, overrides):
    start = {"type": "ekf", "start": {"method": method, "window": 0.035}}
    prepared = prepare(overrides, HashableDict(start))
    assert prepared.depends_on_time("f")
    said = assert_alone(prepared, lambda: prepared.estimator("f"), by_clock=True, atol=1e-6)
    assert any(not s["nis_dof"] for s in said)  # while the readings are gathered


@pytest.mark.parametrize("overrides", [(), LATE], ids=["on time", "late"])
def test_a_users_estimator_is_given_the_time_of_each_row(overrides):
    prepared = prepare(overrides, HashableDict({"type": f"{__name__}:Clocked"}))
    assert prepared.depends_on_time("f")
    assert_alone(prepared, lambda: prepared.estimator("f"), by_clock=True)


@pytest.mark.parametrize("more", [(), LATE], ids=["on time", "late"])
def test_a_model_is_given_the_time_of_each_row(more):
    more = [o for o in more if "pole" not in o]
    prepared = prepare((*SCHEDULED, *more))
    assert prepared.depends_on_time("f")
    assert_alone(prepared, lambda: prepared.estimator("f"), by_clock=True)


def test_rows_may_begin_one_after_the_other():
    """Not all of them at first: the others have no belief yet."""
    beginnings = {0: ([2], [2]), 3: ([0, 1], [5, 6]), 5: ([2], [7])}
    prepared = prepare(())
    for by_clock in (False, True):
        fleet = Fleet(prepared, 3, beginnings, timed=by_clock)
        alone = {}
        for row, run, elapsed, said in follow(fleet, prepared.estimator("f"), by_clock, 10):
            if row < 2 and run == 0:
                continue  # has not begun
            if run not in alone:
                single = follow(Fleet.alone(prepared, run), prepared.estimator("f"), by_clock)
                alone[run] = {e: s for _, _, e, s in single}
            for name, value in alone[run][elapsed].items():
                np.testing.assert_allclose(said[name], value, rtol=1e-6, atol=1e-8, err_msg=name)


@dataclass(frozen=True)
class Harm:
    """An EKF whose first row breaks down once the time has come."""

    ekf: EKF
    time: float

    def __getattr__(self, name):
        return getattr(self.ekf, name)

    def predict(self, belief, u, t, dt):
        belief = self.ekf.predict(belief, u, t, dt)
        if t > self.time and len(belief.mean) == 4:
            belief.mean[0] = np.nan
        return belief


def test_a_row_that_failed_keeps_its_last_estimate_until_it_begins_anew():
    prepared = prepare(())
    fleet = Fleet(prepared, 4, {0: BEGINNINGS[0], 8: ([1], [4]), 10: ([0], [5])})
    harmed = Harm(EKF(prepared.model()), 0.045)
    seen = [
        (elapsed, said) for row, _, elapsed, said in follow(fleet, harmed, False, 16) if row == 0
    ]
    failed = [bool(said["diverged"]) for _, said in seen[:11]]
    assert failed == [False] * 5 + [True] * 5 + [False]
    last = seen[4][1]["estimate"]
    for _, said in seen[5:10]:
        np.testing.assert_array_equal(said["estimate"], last)
        assert said["nees"] == np.inf
    assert np.isfinite(seen[10][1]["estimate"]).all()


def test_an_estimator_that_raises_is_named():
    class Raises(EKF):
        def predict(self, belief, u, t, dt):
            raise ZeroDivisionError("gain")

    prepared = prepare(())
    with pytest.raises(EstimatorError, match=r"Raises raised ZeroDivisionError: gain"):
        list(follow(Fleet.alone(prepared, 0), Raises(prepared.model()), False))
