"""Rows that begin at different times are filtered as their runs are alone, also what is late."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from estbench.errors import SelectionError
from estbench.estimators import registry
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ekf import EKF
from estbench.inference.fusion import Delays, Fusion
from estbench.inference.inbox import Inbox
from estbench.inference.latest import LatestInnovations
from estbench.sensors.clock import Clocks, Event
from estbench.sensors.delivery import Delivery
from estbench.sensors.timing import Schedule, Timing
from estbench.spaces.manifold import Manifold
from tests.helpers import ChannelModel, nonlinear_model, random_cov

ROWS, PERIODS = 5, 14
# Control periods of 3 ticks, divided at every second and every fifth tick of an episode.
SCHEDULE = Schedule([("a", Timing(2)), ("b", Timing(5))], 0.05, 3)
COMPONENTS = {"a": [0, 1], "b": [2]}
SPACES = {name: Manifold.euclidean(len(which)) for name, which in COMPONENTS.items()}
# control period -> the rows that begin there, and their runs.
BEGINNINGS = {
    0: ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4]), 2: ([1], [5]), 5: ([0, 3], [6, 7]), 6: ([1], [8]),
    7: ([3, 4], [2, 9]),
}  # fmt: skip


def model() -> Any:
    return ChannelModel(nonlinear_model(4), COMPONENTS)


@dataclass(frozen=True)
class Whole(Gaussian):
    """A belief with something of its own, so that it is not worked on in a few rows."""

    count: Any = None


class Undivided(EKF):
    """An EKF whose belief goes through every update as a whole."""

    def init(self, mean, cov):
        start = super().init(mean, cov)
        return Whole(start.mean, start.cov, start.fault, np.zeros(len(mean)))

    def update(self, belief, *arguments, **options):
        belief, innovation = super().update(belief, *arguments, **options)
        return replace(belief, count=belief.count + 1), innovation


def made(kind):
    return Undivided(model()) if kind == "whole" else registry.create(kind, {}, model())


@cache
def told(run):
    """What a run's sensors say: (arrival, channel, taken, due, y), by its own clock, in ticks."""
    rng = np.random.default_rng(run)
    ticks = [i.tick for k in range(PERIODS + 4) for i in SCHEDULE.period(k)]
    out = []
    for tick in ticks:
        for channel, which in COMPONENTS.items():
            if rng.random() < 0.7:
                late = int(rng.integers(0, 9)) if rng.random() < 0.5 else 0
                arrival = next((t for t in ticks if t >= tick + late), None)
                due = max(1, tick + int(rng.integers(-1, 2)))
                y = np.array([2.5, 0.9, 0.2])[which] + 0.2 * rng.standard_normal(len(which))
                out.append((arrival, channel, tick, due, y))
    return out


def arriving(event, began, runs):
    """The deliveries of an event, the rows that share channel and time in one."""
    out: dict[Any, Delivery] = {}
    rows = len(runs)
    for row in range(rows) if event.rows is None else np.flatnonzero(event.rows):
        now = event.tick - began[row]
        for arrival, channel, taken, due, y in told(runs[row]):
            if arrival != now:
                continue
            key = channel, int(taken + began[row])
            if key not in out:
                empty = np.zeros((rows, len(y)))
                out[key] = Delivery(
                    channel, np.zeros(rows, np.int64), empty, np.zeros(rows, bool), key[1]
                )
            d: Any = out[key]
            d.y[row], d.mask[row], d.due[row] = y, True, due + began[row]
    return [out[key] for key in sorted(out)]


def start_of(run):
    rng = np.random.default_rng(1000 + run)
    return 0.2 * rng.standard_normal(4), random_cov(rng, 4, scale=0.05)


def control(event, began, runs):
    return np.array([[np.sin(0.3 * (event.tick - b) + run)] for b, run in zip(began, runs)])


def filtered(kind, delays, rows, beginnings, periods):
    """(row, run, elapsed, x̂, P, readings too late) of every row at every event of its own."""
    estimator, clocks = made(kind), Clocks(rows, SCHEDULE)
    mean, cov = (np.array(each) for each in zip(*[start_of(run) for run in beginnings[0][1]]))
    began, runs = np.zeros(rows, int), np.array(beginnings[0][1])
    log = LatestInnovations(SPACES, rows, delays.window > 0)
    fusion = Fusion(estimator, estimator.init(mean, cov), Inbox(SPACES), delays, log)
    for period in range(periods):
        if period and period in beginnings:
            here, new = beginnings[period]
            clocks.start(np.array(here))
            began[here], runs[here] = clocks.tick, new
            for row, run in zip(here, new):
                mean[row], cov[row] = start_of(run)
            mask = np.isin(np.arange(rows), here)
            fusion.restart(mask, estimator.init(mean.copy(), cov.copy()))
        for event in clocks.period():
            log.begin()
            u = control(event, began, runs)
            log.settle(fusion.step(event, u, arriving(event, began, runs)))
            x, P = estimator.mean(fusion.belief), estimator.cov(fusion.belief)
            for row in range(rows) if event.rows is None else np.flatnonzero(event.rows):
                elapsed = int(event.tick - began[row])
                said = log.nis[row], log.dof[row], log.innovation[row].copy()
                yield row, int(runs[row]), elapsed, x[row], P[row], int(fusion.late[row]), said


DELAYS = {
    "wide": Delays(window=40),
    "narrow": Delays(window=5),
    "none": Delays(),
    "naive": Delays("naive"),
    "believed": Delays(window=9, believed={"a": 2}),
    "due": Delays(window=9, nominal=frozenset({"b"})),
}


@pytest.mark.parametrize("delays", DELAYS)
@pytest.mark.parametrize("kind", ["ekf", "sr_ekf", "ukf", "kf", "whole"])
def test_each_row_is_its_run_alone(kind, delays):
    alone = {
        run: {
            elapsed: rest
            for _, _, elapsed, *rest in filtered(kind, DELAYS[delays], 1, {0: ([0], [run])}, 14)
        }
        for run in range(10)
    }
    compared, late = 0, 0
    for row, run, elapsed, x, P, count, (nis, dof, innovation) in filtered(
        kind, DELAYS[delays], ROWS, BEGINNINGS, PERIODS
    ):
        mean, cov, lost, said = alone[run][elapsed]
        where = f"row {row}, run {run}, {elapsed} ticks after its start"
        np.testing.assert_allclose(x, mean, rtol=0, atol=1e-12, err_msg=where)
        np.testing.assert_allclose(P, cov, rtol=0, atol=1e-12, err_msg=where)
        np.testing.assert_allclose(nis, said[0], rtol=1e-9, atol=1e-9, err_msg=where)
        np.testing.assert_allclose(innovation, said[2], rtol=0, atol=1e-10, err_msg=where)
        assert (count, dof) == (lost, said[1])
        compared += 1
        late += count
    assert compared > 150
    assert (late > 0) == (delays in ("narrow", "none", "believed", "due"))


def test_going_back_is_the_posterior_of_readings_on_time():
    """Where all readings have come, at the time of the last: rows of any clock."""
    final = {
        row: (x, P) for row, _, _, x, P, *_ in filtered("ekf", DELAYS["wide"], ROWS, BEGINNINGS, 10)
    }
    ekf = EKF(model())
    for row, (begun, run) in enumerate([(5, 6), (6, 8), (0, 2), (7, 2), (7, 9)]):
        instants = [i for k in range(10 - begun) for i in SCHEDULE.period(k)]
        belief, now = ekf.init(*(each[None] for each in start_of(run))), instants[-1].tick
        for i in instants:
            u = np.array([[np.sin(0.3 * i.tick + run)]])
            belief = ekf.predict(belief, u, i.start, i.end - i.start)
            known = {c: y for at, c, taken, _, y in told(run) if taken == i.tick and at <= now}
            if known:
                y = np.concatenate(list(known.values()))[None]
                belief, _ = ekf.update(belief, y, u, i.end, tuple(known))
        np.testing.assert_allclose(final[row][0], belief.mean[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(final[row][1], belief.cov[0], rtol=0, atol=1e-12)


def test_the_shortest_window_holds_the_reading_before():
    instants = Schedule([("a", Timing(1))], 0.1, 1).period
    ekf, start = EKF(model()), [each[None] for each in start_of(0)]
    u, y = np.zeros((1, 1)), np.array([[2.5, 0.9]])
    log = LatestInnovations(SPACES, 1, True)
    fusion = Fusion(ekf, ekf.init(*start), Inbox(SPACES), Delays(window=1), log)
    belief = ekf.init(*start)
    for k in range(3):
        (i,) = instants(k)
        late = [Delivery(("a",), 1, y, None, 1)] if i.tick == 2 else []
        fusion.step(Event(i.tick, i), u, late)
        belief = ekf.predict(belief, u, i.start, i.end - i.start)
        if i.tick == 1:
            belief, _ = ekf.update(belief, y, u, i.end, ("a",))
    assert fusion.late.tolist() == [0]
    np.testing.assert_array_equal(fusion.belief.mean, belief.mean)
    np.testing.assert_array_equal(fusion.belief.cov, belief.cov)


def test_a_row_that_begins_anew_forgets_what_was_too_late():
    delays = Delays(window=1)
    counts: dict[Any, list[tuple[int, int]]] = {}
    for row, _, elapsed, _, _, late, _ in filtered("ekf", delays, ROWS, BEGINNINGS, PERIODS):
        counts.setdefault(row, []).append((elapsed, late))
    before = 0
    for row, seen in counts.items():
        begins = [i for i in range(1, len(seen)) if seen[i][0] < seen[i - 1][0]]
        assert len(begins) == sum(row in rows for p, (rows, _) in BEGINNINGS.items() if p)
        for i in begins:
            assert seen[i] == (2, 0)  # nothing can be late at the first event
            before += seen[i - 1][1]
    assert before > 5


def test_a_belief_that_cannot_be_taken_apart_stays_as_it_was():
    class Lists(EKF):
        def init(self, mean, cov):
            return [super().init(mean, cov), object()]

    lists = Lists(model())
    mean, cov = (np.array(each) for each in zip(*[start_of(run) for run in range(3)]))
    log = LatestInnovations(SPACES, 3)
    before = lists.init(mean, cov)
    fusion = Fusion(lists, before, Inbox(SPACES), Delays(window=4), log)
    fusion.late[:] = 5
    with pytest.raises(SelectionError, match="is not kept row by row"):
        fusion.restart(np.array([True, False, False]), lists.init(mean + 1, cov))
    assert fusion.belief is before
    np.testing.assert_array_equal(fusion.late, 5)
