"""Rows on clocks of their own go through the instants of their own episodes."""

import numpy as np
import pytest

from estbench.sensors.clock import Clocks
from estbench.sensors.timing import Schedule, Timing

ROWS, TIMESTEP = 6, 0.01
SCHEDULES = {
    "plain": (4, [Timing(4), Timing(8, phase=4)]),
    "between": (4, [Timing(3), Timing(8)]),
    "phase": (4, [Timing(8, phase=13)]),
    "jitter": (5, [Timing(10, jitter=2), Timing(5)]),
    "fractional": (3, [Timing(2, fractional=(1.5, 2.5))]),
    "all": (3, [Timing(7, jitter=3), Timing(2, fractional=(2.25, 2.25)), Timing(6, latency=4.0)]),
}


def schedule(name):
    frame_skip, timings = SCHEDULES[name]
    return Schedule([(f"c{i}", t) for i, t in enumerate(timings)], TIMESTEP, frame_skip)


def seen(clocks, events, rows=ROWS):
    """What each row sees of events: (tick, nstep, start, end), in order, the last two in s."""
    out = [[] for _ in range(rows)]
    for event in events:
        start, end = clocks.time(event)
        starts, ends = (np.broadcast_to(t, (rows, 1))[:, 0] for t in (start, end))
        for row in range(rows) if event.rows is None else np.flatnonzero(event.rows):
            out[row].append((event.tick, event.instant.nstep, starts[row], ends[row]))
    return out


def alone(plan, now, elapsed):
    """The same of one row, `elapsed` ticks after it began."""
    instants = plan.period(elapsed // plan.frame_skip)
    return [(now - elapsed + i.tick, i.nstep, i.start, i.end) for i in instants]


@pytest.mark.parametrize("name", SCHEDULES)
@pytest.mark.parametrize("timed", [False, True])
def test_the_periods_of_rows_that_began_at_different_ticks(name, timed):
    plan, rng = schedule(name), np.random.default_rng(3)
    clocks, began, tick = Clocks(ROWS, plan, timed), np.zeros(ROWS, int), 0
    apart = 0
    for number in range(40):
        if number > 3 and rng.random() < 0.4:
            rows = rng.permutation(ROWS)[: rng.integers(1, ROWS + 1)]
            clocks.start(rows)
            began[rows] = tick
        if number == 30:  # all together again
            clocks.start(np.arange(ROWS))
            began[:] = tick
        np.testing.assert_array_equal(clocks.elapsed, tick - began)
        assert clocks.shared == (len(set(began.tolist())) == 1)
        mask = rng.random(ROWS) < 0.7 if rng.random() < 0.5 else None
        events = clocks.period(mask)
        assert [e.tick for e in events] == sorted(e.tick for e in events)
        for row, found in enumerate(seen(clocks, events)):
            expected = alone(plan, tick, tick - began[row])
            if mask is not None and not mask[row]:
                expected = []
            assert [f[:2] for f in found] == [e[:2] for e in expected]
            np.testing.assert_allclose(
                [f[2:] for f in found], [e[2:] for e in expected], rtol=0, atol=1e-12
            )
        if timed:
            assert_one_clock(events, began)
        apart += not clocks.shared
        tick += plan.frame_skip
        assert clocks.tick == tick
    assert apart > 10


def assert_one_clock(events, began):
    """The instant of each event is that of all of its rows."""
    for event in events:
        rows = np.ones(ROWS, bool) if event.rows is None else event.rows
        np.testing.assert_array_equal(event.tick - began[rows], event.instant.tick)
        assert event.instant.end == pytest.approx(event.instant.tick * TIMESTEP)
        assert event.instant.start == pytest.approx(event.instant.end - event.instant.nstep * 0.01)


@pytest.mark.parametrize("timed", [False, True])
def test_intervals_of_any_length(timed):
    rng = np.random.default_rng(1)
    clocks, began, tick = Clocks(ROWS, schedule("plain"), timed), np.zeros(ROWS, int), 0
    for number in range(30):
        if number > 3 and rng.random() < 0.4:
            rows = rng.permutation(ROWS)[: rng.integers(1, ROWS + 1)]
            clocks.start(rows)
            began[rows] = tick
        nstep = int(rng.integers(1, 6))
        mask = rng.random(ROWS) < 0.7 if rng.random() < 0.5 else None
        events = clocks.interval(nstep, mask)
        tick += nstep
        for row, found in enumerate(seen(clocks, events)):
            if mask is not None and not mask[row]:
                assert found == []
                continue
            ((at, steps, start, end),) = found
            assert (at, steps) == (tick, nstep)
            assert end == pytest.approx((tick - began[row]) * TIMESTEP, abs=1e-12)
            assert start == pytest.approx(end - nstep * TIMESTEP, abs=1e-12)
        if timed:
            assert_one_clock(events, began)


def test_rows_whose_instants_lie_alike_go_on_together_unless_the_time_matters():
    """Readings every 8 ticks, control every 4: the periods are of two kinds."""
    plan = Schedule([("a", Timing(8, phase=2))], TIMESTEP, 4)
    for timed, kinds in ((False, 2), (True, 4)):
        clocks = Clocks(4, plan, timed)
        for row in (1, 2, 3):
            clocks.period()
            clocks.start(np.array([row]))
        masks = {tuple(event.rows.tolist()) for event in clocks.period() if event.rows is not None}
        assert len(masks) == kinds
        assert np.sum(list(masks), axis=0).tolist() == [1, 1, 1, 1]


def test_rows_outside_the_mask_make_no_event():
    clocks = Clocks(3, schedule("between"), True)
    clocks.period()
    clocks.start(np.array([1]))
    events = clocks.period(np.array([False, True, False]))
    masks = [None if event.rows is None else event.rows.tolist() for event in events]
    assert masks
    assert all(mask == [False, True, False] for mask in masks)
