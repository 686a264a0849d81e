"""Efficiency and its interval."""

import numpy as np
import pytest

from estbench.consistency import efficiency
from estbench.consistency.intervals import NONE


def test_of_each_coordinate_and_of_all_together():
    bound, mse = np.array([[1.0, 4.0], [3.0, 4.0]]), np.array([[2.0, 40.0], [6.0, 120.0]])
    first, second = efficiency.by_coordinate(bound, mse)
    assert first.value == pytest.approx(0.5)
    assert second.value == pytest.approx(0.05)
    found = efficiency.together(bound, mse)
    assert found.value == pytest.approx(2 / (1 / 0.5 + 1 / 0.05))
    assert found.low < found.value < found.high


def test_bound_and_error_are_paired():
    """Where the bound of each run is a constant part of its error the interval has no width."""
    mse = np.random.default_rng(0).random((30, 2)) + 0.5
    found = efficiency.together(0.4 * mse, mse)
    assert found.low == pytest.approx(0.4)
    assert found.high == pytest.approx(0.4)


@pytest.mark.parametrize("known", [40, 10])
def test_the_interval_covers(known):
    """Nominal 95%. Of 1,500 experiments 93.1% to 96.9% would cover if exact, at 99.9%.

    The bound is known for all runs, or for a quarter of them.

    Errors of 40 runs, each the mean of 8 squares; the skewness of squares costs some percent.
    """
    rng, inside = np.random.default_rng(1), 0
    for _ in range(1500):
        errors = (rng.standard_normal((40, 8, 2)) ** 2).mean(axis=1)
        bound = 0.8 * np.array([1.0, 0.5]) * (1 + 0.1 * rng.standard_normal((40, 1)))
        bound[known:] = np.nan
        inside += 2 / (1 / 0.8 + 1 / 0.4) in efficiency.together(bound, errors)
    assert 0.92 < inside / 1500 < 0.97


def test_the_error_of_all_runs_counts_where_few_have_a_bound():
    """The bound's spread counts as that of the mean over its own runs."""
    rng = np.random.default_rng(2)
    mse, bound = np.full((400, 1), 2.0), np.full((400, 1), np.nan)
    bound[:25] = 1 + 0.2 * rng.standard_normal((25, 1))
    found = efficiency.together(bound, mse)
    assert found.value == pytest.approx(bound[:25].mean() / 2)
    half = 2.064 * bound[:25].std(ddof=1) / 5 / bound[:25].mean()  # Student's t, 24 dof
    assert np.log(found.high / found.value) == pytest.approx(half, rel=0.03)


def test_without_a_bound_or_without_runs_there_is_none():
    nothing, mse = np.full((5, 2), np.nan), np.ones((5, 2))
    assert efficiency.together(nothing, mse) == NONE
    assert efficiency.by_coordinate(nothing, mse) == (NONE, NONE)
    assert efficiency.together(np.ones((0, 2)), np.ones((0, 2))) == NONE
    assert efficiency.together(np.ones((5, 2)), np.zeros((5, 2))) == NONE
    one = efficiency.together(np.ones((1, 2)), mse[:1])
    assert (one.low, one.value, one.high) == (0.0, 1.0, np.inf)
