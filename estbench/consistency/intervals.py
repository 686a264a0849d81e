"""Intervals of shares, means, trimmed means and medians over runs, and how many runs they need.

The runs are independent, the steps of one are not: every function takes one value a run.
"""

from collections.abc import Callable

import numpy as np
from scipy import stats

from estbench.consistency.nees import Interval
from estbench.shapes import Array


def wilson(count: int, total: int, level: float = 0.95) -> Interval:
    """Wilson's score interval of a share (Wilson 1927, JASA 22).

    Unlike the normal one it says something of a share of 0 or 1. No trials give NaN.

    Args:
        count: successes.
        total: trials.
        level: confidence.
    """
    if not total:
        return Interval(np.nan, np.nan, np.nan)
    found = stats.binomtest(count, total).proportion_ci(level, method="wilson")
    return Interval(count / total, float(found.low), float(found.high))


def bootstrap(
    values: Array,
    statistic: Callable[..., Array] = np.mean,
    level: float = 0.95,
    resamples: int = 4999,
    seed: int = 0,
) -> Interval:
    """Bias-corrected and accelerated bootstrap interval (Efron 1987, JASA 82).

    For a statistic of which no formula is at hand. With fewer than some 20 runs prefer a formula:
    resampling cannot show values that were not seen. One value gives no interval (-inf, inf),
    none gives NaN.

    Args:
        values: one a run `(run,)`; values that are not finite are left out.
        statistic: takes an array and `axis`.
        level: confidence.
        resamples: how many.
        seed: of the resampling.
    """
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return Interval(np.nan, np.nan, np.nan)
    value = float(statistic(values, axis=0))
    if len(values) == 1:
        return Interval(value, -np.inf, np.inf)
    if np.ptp(values) == 0:
        return Interval(value, value, value)
    found = stats.bootstrap(
        (values,), statistic, n_resamples=resamples, confidence_level=level, method="BCa",
        rng=np.random.default_rng(seed), vectorized=True,
    ).confidence_interval  # fmt: skip
    return Interval(value, float(found.low), float(found.high))


def trimmed_mean(values: Array, share: float = 0.1, level: float = 0.95) -> Interval:
    """Mean without the largest and smallest `share` of the values (Tukey & McLaughlin 1963).

    Student's t with h - 1 degrees of freedom, h = N - 2 ⌊share N⌋ values kept, and the standard
    error √(SSD_w / (h (h - 1))), SSD_w the sum of squared deviations of the Winsorized values.
    A value that is not finite stands for a run that was lost and is the largest: with more of
    them than are trimmed the trimmed mean is infinite.

    Args:
        values: one a run `(run,)`.
        share: left out at each end, below 0.5.
        level: confidence.
    """
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    count = len(ordered)
    g = int(share * count)
    core = ordered[g : count - g]
    if len(core) == 0:
        return Interval(np.nan, np.nan, np.nan)
    mean = float(core.mean())
    if len(core) < 2 or not np.isfinite(core[-1]):
        return Interval(mean, -np.inf, np.inf)
    squares = np.clip(ordered, core[0], core[-1]).var() * count
    spread = np.sqrt(squares / (len(core) * (len(core) - 1)))
    half = float(stats.t.ppf(0.5 + level / 2, len(core) - 1) * spread)
    return Interval(mean, mean - half, mean + half)


def median(values: Array, level: float = 0.95) -> Interval:
    """Median with the exact interval from order statistics, whatever the distribution.

    It covers with at least `level` (Conover 1999, sec. 3.2). Where the values are too few for that
    (fewer than 6 at 95%) it is (-inf, inf). A value that is not finite stands for a run that was
    lost and is the largest.
    """
    if len(values) == 0:
        return Interval(np.nan, np.nan, np.nan)
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    found = stats.quantile_test(ordered, p=0.5).confidence_interval(level)
    low, high = (-np.inf, np.inf) if np.isnan(found.low) else (found.low, found.high)
    return Interval(float(np.median(ordered)), float(low), float(high))


def runs_needed(values: Array, half_width: float, level: float = 0.95) -> int | None:
    """Runs for which Student's t interval of the mean has at most this half-width.

    The least N with t(N - 1) s/√N <= half_width, s from the runs at hand; a guess from few runs is
    as uncertain as their s. None where fewer than two values are finite.

    Args:
        values: one a run `(run,)`, of a pilot experiment.
        half_width: wanted, in the values' unit, positive.
        level: confidence.
    """
    values = values[np.isfinite(values)]
    if len(values) < 2 or not half_width > 0:
        return None
    ratio = float(values.std(ddof=1)) / half_width
    count = max(2, int((stats.norm.ppf(0.5 + level / 2) * ratio) ** 2))
    while stats.t.ppf(0.5 + level / 2, count - 1) * ratio > np.sqrt(count):
        count += 1
    return count
