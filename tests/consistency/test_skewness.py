import numpy as np
import pytest
from scipy import stats

from estbench.consistency.skewness import skewness, skewness_interval


def moments(values):
    return np.stack([values, values**2, values**3], axis=-1)


def test_it_is_that_of_scipy():
    values = np.random.default_rng(0).gamma(2.0, 1.0, (40, 25)) - 1.0
    each = moments(values).mean(axis=1)
    assert skewness_interval(each).value == pytest.approx(stats.skew(values.ravel()), rel=1e-12)


def test_the_interval_is_the_jackknife_of_the_textbook():
    values = np.random.default_rng(1).exponential(1.0, (12, 9))
    found = skewness_interval(moments(values).mean(axis=1), 0.9)
    without = [stats.skew(np.delete(values, i, axis=0).ravel()) for i in range(12)]
    spread = np.sqrt(11 / 12 * ((without - np.mean(without)) ** 2).sum())
    half = stats.t.ppf(0.95, 11) * spread
    assert (found.high - found.value, found.value - found.low) == pytest.approx((half, half))


def test_few_runs_and_no_variance():
    assert np.isnan(skewness_interval(np.full((4, 3), np.nan)).value)
    assert np.isnan(skewness_interval(moments(np.full(5, 2.0))).value)
    two = skewness_interval(moments(np.array([[0.0, 1.0, 5.0], [1.0, 2.0, 9.0]])).mean(axis=1))
    assert np.isfinite(two.value)
    assert (two.low, two.high) == (-np.inf, np.inf)


def test_skewness_of_a_symmetric_error_is_zero():
    assert skewness(moments(np.array([-2.0, -1.0, 1.0, 2.0])).mean(axis=0)) == 0.0
