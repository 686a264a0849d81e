from math import comb

import numpy as np
import pytest
from scipy import stats

from estbench.consistency import intervals
from estbench.consistency.intervals import positive_mean_interval

# Bands of a count of `k` hits in `n` are taken at p = 1e-6: one false alarm in a million runs of a
# test with another seed; the seeds are fixed.


def band(level, n, p=1e-6):
    return stats.binom.ppf([p / 2, 1 - p / 2], n, level) / n


def within(hits, n, level):
    low, high = band(level, n)
    return low <= hits / n <= high


# Shares


@pytest.mark.parametrize(("count", "total"), [(0, 20), (3, 20), (20, 20), (17, 431)])
@pytest.mark.parametrize("level", [0.9, 0.95])
def test_wilson_solves_its_quadratic(count, total, level):
    # The bounds are the p with |count/total - p| = z sqrt(p (1 - p)/total).
    i = intervals.wilson(count, total, level)
    z, share = stats.norm.ppf(0.5 + level / 2), count / total
    for p in (i.low, i.high):
        assert (share - p) ** 2 == pytest.approx(z**2 * p * (1 - p) / total, abs=1e-12)
    assert i.low <= i.value <= i.high


def test_wilson_covers_on_the_average_as_often_as_it_says():
    # By enumeration, no chance in it: the coverage of p, averaged over p.
    n, ps = 40, np.linspace(0.02, 0.98, 97)
    found = [intervals.wilson(k, n) for k in range(n + 1)]
    inside = np.array([[i.low <= p <= i.high for i in found] for p in ps])
    coverage = (inside * stats.binom.pmf(np.arange(n + 1), n, ps[:, None])).sum(axis=1)
    assert coverage.mean() == pytest.approx(0.95, abs=0.01)
    assert coverage.min() > 0.83


def test_no_trials():
    assert np.isnan(intervals.wilson(0, 0).value)


# The mean of positive values


def test_positive_mean_by_the_equation():
    x = np.array([0.8, 1.7, 1.1, 0.6, 2.2])
    i = positive_mean_interval(x, 0.9)
    c = x.std(ddof=1) / x.mean()
    v, q = c**2 / 5 / 9, stats.t.ppf(0.95, 4 / (1 + c**2))
    for mu, sign in ((i.low, 1), (i.high, -1)):
        assert (x.mean() / mu) ** (1 / 3) == pytest.approx(1 - v + sign * q * np.sqrt(v))
    assert i.value == x.mean()


@pytest.mark.parametrize("scale", [1e-12, 3.0])
def test_positive_mean_scales_with_the_unit(scale):
    x = np.random.default_rng(0).gamma(2.0, size=9)
    one, other = positive_mean_interval(x), positive_mean_interval(scale * x)
    assert [other.low, other.high] == pytest.approx([scale * one.low, scale * one.high])


def test_positive_mean_of_alike_values_is_students():
    x = np.random.default_rng(1).normal(5.0, 0.01, 30)
    half = stats.t.ppf(0.975, 29) * x.std(ddof=1) / np.sqrt(30)
    i = positive_mean_interval(x)
    assert [i.low, i.high] == pytest.approx([x.mean() - half, x.mean() + half], rel=1e-5)


@pytest.mark.parametrize("shape", [2.0, 5.0, 50.0])  # 4, 10, 100 degrees of freedom per run
@pytest.mark.parametrize("runs", [3, 5, 10, 50])
def test_positive_mean_covers_skewed_averages(shape, runs):
    count = 2000
    x = np.random.default_rng([int(shape), runs]).gamma(shape, 1 / shape, (count, runs))
    found = [positive_mean_interval(row) for row in x]
    above, below = (sum(i.low > 1 for i in found), sum(i.high < 1 for i in found))
    # Refused 5% of the time within 1.5 points (the formula's bias) and chance; no side above 4%.
    low, high = band(0.05, count)
    assert low - 0.015 < (above + below) / count < high + 0.015
    assert max(above, below) / count < band(0.04, count)[1]


def test_positive_mean_of_few():
    assert positive_mean_interval(np.array([2.0])).high == np.inf
    assert np.isnan(positive_mean_interval(np.array([np.nan])).value)
    wide = positive_mean_interval(np.array([1e-9, 1.0]))
    assert 0 <= wide.low < wide.value < wide.high == np.inf
    alike = positive_mean_interval(np.full(4, 2.0))
    assert (alike.low, alike.high) == (2.0, 2.0)


# Bootstrap


def test_bootstrap_of_many_is_the_formula():
    x = np.random.default_rng(2).exponential(size=400)
    half = 1.96 * x.std() / 20
    i = intervals.bootstrap(x, level=0.95, resamples=2000)
    assert i.value == pytest.approx(x.mean())
    assert [i.low, i.high] == pytest.approx([x.mean() - half, x.mean() + half], abs=0.25 * half)
    assert i.high - i.value > i.value - i.low  # skewed to the right


def test_bootstrap_takes_another_statistic_and_is_repeatable():
    x = np.random.default_rng(3).normal(size=60)
    one, two = (intervals.bootstrap(x, np.median, resamples=500) for _ in range(2))
    assert one == two
    assert one.low <= np.median(x) <= one.high
    assert intervals.bootstrap(x, np.median, resamples=500, seed=1) != one


def test_bootstrap_covers():
    count = 300
    samples = np.random.default_rng(4).normal(size=(count, 40))
    hits = sum(0.0 in intervals.bootstrap(x, resamples=400) for x in samples)
    assert within(hits, count, 0.94)  # a little too narrow at 40 values, as is known


def test_bootstrap_of_few():
    assert np.isnan(intervals.bootstrap(np.array([np.inf])).value)
    assert intervals.bootstrap(np.array([3.0])).low == -np.inf
    assert intervals.bootstrap(np.array([3.0, 3.0])).high == 3.0


# Trimmed means and medians


def test_trimmed_mean_by_hand():
    x = np.array([9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, np.nan])
    i = intervals.trimmed_mean(x, 0.2)  # the lost run is the largest: keeps 3 ... 8
    assert i.value == pytest.approx(np.mean([3, 4, 5, 6, 7, 8]))
    winsorized = np.array([3, 3, 3, 4, 5, 6, 7, 8, 8, 8.0])
    squares = ((winsorized - winsorized.mean()) ** 2).sum()
    half = stats.t.ppf(0.975, 5) * np.sqrt(squares / (6 * 5))
    assert [i.low, i.high] == pytest.approx([i.value - half, i.value + half])


def test_trimmed_mean_is_scipys():
    x = np.random.default_rng(5).standard_t(2, 37)
    for share in (0.0, 0.1, 0.25):
        assert intervals.trimmed_mean(x, share).value == pytest.approx(stats.trim_mean(x, share))


def test_trimmed_mean_covers_heavy_tails():
    count = 2000
    samples = np.random.default_rng(6).standard_t(2, (count, 40))
    hits = sum(0.0 in intervals.trimmed_mean(x, 0.1) for x in samples)
    low, high = band(0.95, count)
    assert low - 0.01 < hits / count < high + 0.01


def test_more_lost_runs_than_are_trimmed():
    i = intervals.trimmed_mean(np.array([1.0, 2, 3, 4, 5, 6, 7, 8, np.inf, np.inf]), 0.1)
    assert (i.value, i.low, i.high) == (np.inf, -np.inf, np.inf)


@pytest.mark.parametrize("n", [6, 7, 20, 51])
def test_median_covers_at_least_by_the_binomial_distribution(n):
    ordered = np.arange(n, dtype=float)
    i = intervals.median(ordered)
    low, high = int(i.low), int(i.high)
    # The true median is between the order statistics unless too few values are below or above it.
    missed = sum(comb(n, k) for k in range(low + 1)) + sum(
        comb(n, k) for k in range(high + 1, n + 1)
    )
    assert missed / 2**n <= 0.05
    narrower = missed + comb(n, low + 1) + comb(n, high)
    assert narrower / 2**n > 0.05


def test_median_of_few_and_lost():
    assert intervals.median(np.arange(5.0)).low == -np.inf
    i = intervals.median(np.array([*range(10), np.nan, np.inf]))
    assert i.value == 5.5
    assert np.isfinite(i.low)
    assert intervals.median(np.full(9, np.nan)).value == np.inf
    assert np.isnan(intervals.median(np.empty(0)).value)


# How many runs


@pytest.mark.parametrize("half", [0.05, 0.3, 2.0])
def test_runs_needed_is_the_least_that_will_do(half):
    x = np.random.default_rng(7).normal(3.0, 1.3, 25)
    n = intervals.runs_needed(x, half)
    assert n is not None
    width = {k: stats.t.ppf(0.975, k - 1) * x.std(ddof=1) / np.sqrt(k) for k in (n, n - 1) if k > 1}
    assert width[n] <= half
    assert n == 2 or width[n - 1] > half


def test_runs_needed_gives_the_half_width():
    rng = np.random.default_rng(8)
    n = intervals.runs_needed(rng.normal(0, 2.0, 5000), 0.2)
    assert n is not None
    halves = stats.t.ppf(0.975, n - 1) * rng.normal(0, 2.0, (400, n)).std(axis=1, ddof=1) / n**0.5
    assert halves.mean() == pytest.approx(0.2, rel=0.03)


def test_runs_needed_of_nothing():
    assert intervals.runs_needed(np.array([1.0, np.nan]), 0.1) is None
    assert intervals.runs_needed(np.array([1.0, 2.0]), 0.0) is None
    assert intervals.runs_needed(np.array([1.0, 1.0]), 0.1) == 2
    assert intervals.runs_needed(np.array([1.0, 2.0]), 1e-6) == pytest.approx(1.92e12, rel=1e-3)
    assert intervals.runs_needed(np.array([1.0, 2.0]), 1e-9) is None
    assert intervals.runs_needed(np.array([1.0, 2.0]), 1e-200) is None


def test_the_interval_of_squares_that_underflow_is_that_of_larger_ones():
    values = np.array([1.0, 2.0, 4.0])
    large, tiny = positive_mean_interval(values), positive_mean_interval(1e-200 * values)
    for side in ("value", "low", "high"):
        assert getattr(tiny, side) == pytest.approx(1e-200 * getattr(large, side), rel=1e-9, abs=0)
