"""Instants that are made when they are asked for are those that were given."""

import pickle

import numpy as np

from estbench.sensors.instants import Instants
from estbench.sensors.timing import Schedule, Timing

SCHEDULE = Schedule([("a", Timing(4, jitter=1)), ("b", Timing(7))], 0.01, 5)
GIVEN = [instant for k in range(6) for instant in SCHEDULE.period(k)]


def test_they_are_those_that_were_given():
    made = Instants(GIVEN, 0.01)
    assert list(made) == GIVEN
    assert made[-1] == GIVEN[-1]
    assert made[3:7] == tuple(GIVEN[3:7])
    assert made == pickle.loads(pickle.dumps(made))
    assert made != GIVEN[1:]


def test_what_is_counted_over_all_of_them():
    made = Instants(GIVEN, 0.01)
    np.testing.assert_array_equal(made.times, [0.0, *(i.end for i in GIVEN)])
    assert made.controls == sum(i.control for i in GIVEN)
    assert made.longest == max(i.nstep for i in GIVEN)
