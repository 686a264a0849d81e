import doctest

import numpy as np
import pytest
from scipy import stats

from estbench.consistency import nees as consistency
from estbench.consistency.intervals import Interval, mean_interval, positive_mean_interval
from estbench.consistency.nees import chi_square_band, diverged_runs

# Chi-square bands


def test_band_of_one_value_is_the_tables():
    # Two-sided 95 % points of chi-square from printed tables, 2 and 4 degrees of freedom.
    np.testing.assert_allclose(chi_square_band(2, 1), (0.0506, 7.378), atol=5e-4)
    np.testing.assert_allclose(chi_square_band(4, 1), (0.484, 11.143), atol=5e-4)


def test_band_of_the_textbook():
    # Bar-Shalom et al. 2001, sec. 5.4.2: 50 runs of a filter with 2 states: [1.5, 2.6].
    np.testing.assert_allclose(chi_square_band(2, 50), (1.484, 2.591), atol=1e-3)


@pytest.mark.parametrize(("dof", "runs", "level"), [(1, 1, 0.95), (3, 40, 0.9), (12, 500, 0.999)])
def test_band_by_the_distribution_function(dof, runs, level):
    low, high = chi_square_band(dof, runs, level)
    total = stats.chi2(dof * runs)
    assert total.cdf(low * runs) == pytest.approx((1 - level) / 2)
    assert total.sf(high * runs) == pytest.approx((1 - level) / 2)


def test_band_covers_as_often_as_it_says():
    count, dof, runs = 20_000, 3, 25
    means = np.random.default_rng(0).chisquare(dof, (count, runs)).mean(axis=1)
    low, high = chi_square_band(dof, runs, 0.9)
    inside = ((means > low) & (means < high)).mean()
    assert abs(inside - 0.9) < 6 * np.sqrt(0.9 * 0.1 / count)  # false alarm 2e-9
    assert (means < low).mean() == pytest.approx(0.05, abs=6 * np.sqrt(0.05 * 0.95 / count))


@pytest.mark.parametrize("shape", [(3,), (2, 3), (1, 2)])
def test_band_of_arrays_is_that_of_each_element(shape):
    rng = np.random.default_rng(1)
    dof, runs = rng.integers(1, 9, shape), rng.integers(1, 99, shape)
    low, high = chi_square_band(dof, runs)
    assert low.shape == high.shape == shape
    for index in np.ndindex(shape):
        expected = chi_square_band(int(dof[index]), int(runs[index]))
        assert (low[index], high[index]) == pytest.approx(expected)


# Intervals


def test_interval_by_hand():
    # mean 2, s = 1, t(0.975, 2) = 4.30265
    interval = mean_interval(np.array([1.0, np.nan, 2.0, np.inf, 3.0]))
    half = 4.302652729911275 / np.sqrt(3)
    assert (interval.value, interval.low, interval.high) == pytest.approx((2, 2 - half, 2 + half))


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_interval_covers_as_often_as_it_says(level):
    count = 4000
    samples = np.random.default_rng(2).normal(3.0, 2.0, (count, 6))
    hits = sum(3.0 in mean_interval(sample, level) for sample in samples)
    assert abs(hits / count - level) < 6 * np.sqrt(level * (1 - level) / count)


def test_one_value_and_none():
    assert mean_interval(np.array([3.0])) == Interval(3.0, -np.inf, np.inf)
    for nothing in ([], [np.nan]):
        assert np.isnan(mean_interval(np.array(nothing)).value)


def test_contains():
    assert 1.0 in Interval(1.0, 1.0, 1.0)
    assert 0.9 not in Interval(1.5, 1.0, 2.0)
    assert 2.1 not in Interval(1.5, 1.0, 2.0)


# Divergence


def test_diverged_runs_by_hand():
    normalized = np.array(
        [
            [0, 9, 9, 9, np.nan, 9],
            [9, 9, 0, 9, 9, 9],
            [9, 0, 9, 9, 9, 5],
            [9, 9, 9, 0, 0, 9],
        ]
    )  # above 5 for: 3 (the end), 2, 2, 3 (the start), 2, 2 steps in a row
    assert diverged_runs(normalized, 5.0, 3).tolist() == [True, False, False, True, False, False]
    assert diverged_runs(normalized, 5.0, 2).all()
    assert not diverged_runs(normalized, 5.0, 4).any()


@pytest.mark.parametrize("window", [0, 1])
def test_a_window_of_nothing_is_one_step(window):
    normalized = np.array([[0.0, 9.0], [0.0, 0.0]])
    assert diverged_runs(normalized, 5.0, window).tolist() == [False, True]


def test_a_window_longer_than_the_run_is_the_whole_run():
    normalized = np.array([[9.0, 9.0], [9.0, 0.0]])
    assert diverged_runs(normalized, 5.0, 99).tolist() == [True, False]


def test_docstring_examples():
    assert doctest.testmod(consistency).failed == 0


@pytest.mark.parametrize("values", [[0.0, 0.0, 0.0], [-0.5, 0.2, 0.1], [-3.0, -4.0, 1.0]])
def test_values_without_a_positive_mean_get_students_interval(values):
    sample = np.array(values)
    assert positive_mean_interval(sample) == mean_interval(sample)
