"""Intervals across runs of means, shares, trimmed means and medians, and how many runs they need.

Runs are independent; the steps of one run are correlated. Every function therefore takes one value
per run. Every quantile of Student's t and of the normal distribution in the package is taken here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # imports its statistics at their first use; a worker has none
from numpy.typing import NDArray

from estbench.shapes import Array, Float, Shaped


@dataclass(frozen=True)
class Interval:
    """An estimate and its confidence interval.

    Attributes:
        value: the estimate.
        low, high: ends of the interval; -inf and inf where the data give none.
    """

    value: float
    low: float
    high: float

    def __contains__(self, x: float) -> bool:
        return self.low <= x <= self.high

    def __neg__(self) -> "Interval":
        """The interval of the negative quantity."""
        return Interval(-self.value, -self.high, -self.low)

    def scaled(self, factor: float) -> "Interval":
        """The interval in a unit that is `factor` times as small, `factor` > 0."""
        return Interval(factor * self.value, factor * self.low, factor * self.high)

    def root(self) -> "Interval":
        """The interval of the square root of a quantity that is not negative."""
        return Interval(*(float(np.sqrt(max(x, 0.0))) for x in (self.value, self.low, self.high)))

    def exponential(self) -> "Interval":
        """The interval of exp of the quantity."""
        with np.errstate(over="ignore"):
            return Interval(*(float(np.exp(x)) for x in (self.value, self.low, self.high)))

    def reciprocal(self) -> "Interval":
        """The interval of the reciprocal of a quantity that is not negative."""
        with np.errstate(divide="ignore"):
            return Interval(*(float(np.divide(1, x)) for x in (self.value, self.high, self.low)))


NONE = Interval(np.nan, np.nan, np.nan)
"""What no values give."""


def student_quantile(
    level: float, dof: float | Float[Array, "*any"]
) -> float | Float[Array, "*any"]:
    """Two-sided quantile of Student's t: |t| is below it with probability `level`.

    Args:
        level: confidence.
        dof: degrees of freedom, not necessarily whole.
    """
    return scipy.stats.t.ppf(0.5 + level / 2, dof)


def normal_quantile(level: float) -> float:
    """Two-sided quantile of the standard normal: |z| is below it with probability `level`."""
    return float(scipy.stats.norm.ppf(0.5 + level / 2))


def mean_interval(values: Float[Array, " run"], level: float = 0.95) -> Interval:
    """Student's t interval of the mean of independent values: m ± t(N - 1) s/√N.

    One value gives no interval (-inf, inf); none gives NaN.

    Args:
        values: one per run; values that are not finite are left out. Average the steps of
            each run first: counted as independent they would make the interval far too narrow.
        level: confidence.
    """
    values = values[np.isfinite(values)]
    count = len(values)
    if count == 0:
        return NONE
    mean = float(values.mean())
    if count == 1:
        return Interval(mean, -np.inf, np.inf)
    half = float(student_quantile(level, count - 1) * values.std(ddof=1) / np.sqrt(count))
    return Interval(mean, mean - half, mean + half)


def positive_mean_interval(values: Float[Array, " run"], level: float = 0.95) -> Interval:
    """Interval of the mean of independent positive values, by `positive_mean_bounds`.

    One value gives no interval (-inf, inf); none gives NaN.

    Args:
        values: one per run; values that are not finite are left out.
        level: confidence.
    """
    values = values[np.isfinite(values)]
    count, mean = len(values), float(values.mean()) if len(values) else 0.0
    if count < 2 or mean <= 0:
        return mean_interval(values, level)
    scale = mean if mean < 1e-150 else 1.0  # the square of a rounding error may underflow
    variance = float((values / scale).var(ddof=1))
    low, high = positive_mean_bounds(mean / scale, variance, count, level)
    return Interval(mean, float(low) * scale, float(high) * scale)


def positive_mean_bounds(
    mean: float | Float[Array, "*any"],
    variance: float | Float[Array, "*any"],
    count: float | Shaped[NDArray[Any], "*#any"],
    level: float = 0.95,
) -> tuple[float | Float[Array, "*any"], Float[Array, "*any"]]:
    """Ends of the interval of the mean of positive values, from their moments.

    NEES/n and the mean squared error of each run are averages of squares, skewed to the right.
    Student's t interval of their mean misses the true value too often, nearly always below it
    (docs/statistics.md has figures). The mean m of N values of coefficient of variation c is
    taken to be gamma with shape N/c², of which the cube root is nearly normal (Wilson & Hilferty
    1931, PNAS 17): (m/μ)^(1/3) ~ N(1 - v, v), v = c²/(9 N), so that

        μ = m / (1 - v ± q √v)³,

    with q Student's quantile for (N - 1)/(1 + c²) degrees of freedom: the relative variance of c²
    of a gamma sample is 2 (1 + c²)/N, not 2/N. For many runs, or little spread, this is the
    t interval.

    Args:
        mean: m, positive.
        variance: of the values, with N - 1 in the denominator.
        count: N, at least 2.
        level: confidence.

    Returns:
        Lower and upper end; the upper one is infinite where 1 - v <= q √v.
    """
    squared = variance / mean**2
    v = squared / count / 9
    half = student_quantile(level, (count - 1) / (1 + squared)) * np.sqrt(v)
    high = 1 - v - half
    with np.errstate(divide="ignore"):
        return mean / (1 - v + half) ** 3, np.where(high > 0, mean / high**3, np.inf)


def normal_mean_square_bounds(
    total: Float[Array, "*any"], count: Shaped[NDArray[Any], "*#any"], level: float = 0.95
) -> tuple[Float[Array, "*any"], Float[Array, "*any"]]:
    """Ends of the interval of the mean square of normal values of mean 0: Σe²/χ²(N).

    Args:
        total: sum of the N squares.
        count: N.
        level: confidence.
    """
    low, high = (total / scipy.stats.chi2.ppf(0.5 + s * level / 2, count) for s in (1, -1))
    return low, high


def wilson(count: int, total: int, level: float = 0.95) -> Interval:
    """Wilson's score interval of a share (Wilson 1927, JASA 22).

    It has a width for shares of 0 and 1 too, unlike the normal one. No trials give NaN.

    Args:
        count: successes.
        total: trials.
        level: confidence.
    """
    if not total:
        return NONE
    found = scipy.stats.binomtest(count, total).proportion_ci(level, method="wilson")
    return Interval(count / total, float(found.low), float(found.high))


def bootstrap(
    values: Float[Array, " run"],
    statistic: Callable[..., Array] = np.mean,
    level: float = 0.95,
    resamples: int = 4999,
    seed: int = 0,
) -> Interval:
    """Bias-corrected and accelerated bootstrap interval (Efron 1987, JASA 82).

    For a statistic whose interval has no formula here. With fewer than some 20 runs prefer a
    formula: resampling cannot show values that were not seen. One value gives no interval
    (-inf, inf); none gives NaN.

    Args:
        values: one per run; values that are not finite are left out.
        statistic: takes an array and `axis`.
        level: confidence.
        resamples: count of resamples.
        seed: of the resampling.
    """
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return NONE
    value = float(statistic(values, axis=0))
    if len(values) == 1:
        return Interval(value, -np.inf, np.inf)
    if np.ptp(values) == 0:
        return Interval(value, value, value)
    found = scipy.stats.bootstrap(
        (values,), statistic, n_resamples=resamples, confidence_level=level, method="BCa",
        rng=np.random.default_rng(seed), vectorized=True,
    ).confidence_interval  # fmt: skip
    return Interval(value, float(found.low), float(found.high))


def trimmed_mean(values: Float[Array, " run"], share: float = 0.1, level: float = 0.95) -> Interval:
    """Mean without the largest and smallest `share` of the values (Tukey & McLaughlin 1963).

    Student's t with h - 1 degrees of freedom, h = N - 2 ⌊share N⌋ values kept, and the standard
    error √(SSD_w / (h (h - 1))), SSD_w the sum of squared deviations of the Winsorized values.

    Args:
        values: one per run. A value that is not finite marks a diverged run and counts as
            the largest: with more of them than are trimmed the trimmed mean is infinite.
        share: left out at each end, below 0.5.
        level: confidence.
    """
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    count = len(ordered)
    g = int(share * count)
    core = ordered[g : count - g]
    if len(core) == 0:
        return NONE
    mean = float(core.mean())
    if len(core) < 2 or not np.isfinite(core[-1]):
        return Interval(mean, -np.inf, np.inf)
    squares = np.clip(ordered, core[0], core[-1]).var() * count
    spread = np.sqrt(squares / (len(core) * (len(core) - 1)))
    half = float(student_quantile(level, len(core) - 1) * spread)
    return Interval(mean, mean - half, mean + half)


def median(values: Float[Array, " run"], level: float = 0.95) -> Interval:
    """Median with the exact interval from order statistics, whatever the distribution.

    It covers with at least `level` (Conover 1999, sec. 3.2). Where the values are too few for that
    (fewer than 6 at 95%) it is (-inf, inf). No values give NaN.

    Args:
        values: one per run. A value that is not finite marks a diverged run and counts as
            the largest.
        level: confidence.
    """
    if len(values) == 0:
        return NONE
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    found = scipy.stats.quantile_test(ordered, p=0.5).confidence_interval(level)
    low, high = (-np.inf, np.inf) if np.isnan(found.low) else (found.low, found.high)
    return Interval(float(np.median(ordered)), float(low), float(high))


def runs_needed(values: Float[Array, " run"], half_width: float, level: float = 0.95) -> int | None:
    """Runs for which Student's t interval of the mean has at most this half-width.

    The least N with t(N - 1) s/√N <= half_width, s from the values given; from few runs the answer
    is as uncertain as their s. None where fewer than two values are finite, and beyond 1e14 runs.

    Args:
        values: one per run, of a pilot experiment.
        half_width: wanted, in the values' unit, positive.
        level: confidence.
    """
    values = values[np.isfinite(values)]
    if len(values) < 2 or not half_width > 0:
        return None
    ratio = float(values.std(ddof=1)) / half_width
    least = normal_quantile(level) * ratio
    if least > 1e7:
        return None
    count = max(2, int(least**2))
    while student_quantile(level, count - 1) * ratio > np.sqrt(count):
        count += 1
    return count
