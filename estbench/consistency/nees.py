"""Is an estimator's covariance to be trusted? NEES, NIS, their chi-square bands, and a verdict.

NEES is (x ⊖ x̂)ᵀ P⁻¹ (x ⊖ x̂), NIS is νᵀ S⁻¹ ν; for a consistent filter they are chi-square with n
and m degrees of freedom (Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4; source 002).
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from estbench.shapes import Array


@dataclass(frozen=True)
class Interval:
    """An estimate and its confidence interval."""

    value: float
    low: float
    high: float

    def __contains__(self, x: float) -> bool:
        return self.low <= x <= self.high


class Verdict(StrEnum):
    """What the NEES says, in a word."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    CONSERVATIVE = "conservative"
    DIVERGING = "diverging"
    UNDECIDED = "undecided"


def mean_interval(values: Array, level: float = 0.95) -> Interval:
    """Student's t interval of the mean of independent values `(run,)`; NaNs are left out.

    The values are one number a run. Steps of one run are correlated, so they are averaged first:
    counting them as independent would make the interval far too narrow. One value gives no
    interval (-inf, inf); none gives NaN.
    """
    values = values[np.isfinite(values)]
    count = len(values)
    if count == 0:
        return Interval(np.nan, np.nan, np.nan)
    mean = float(values.mean())
    if count == 1:
        return Interval(mean, -np.inf, np.inf)
    half = float(stats.t.ppf(0.5 + level / 2, count - 1) * values.std(ddof=1) / np.sqrt(count))
    return Interval(mean, mean - half, mean + half)


def positive_mean_interval(values: Array, level: float = 0.95) -> Interval:
    """Interval of the mean of independent positive values `(run,)`; NaNs are left out.

    A run's NEES/n and its mean squared error are averages of squares, skewed to the right, and
    Student's t interval of their mean then misses the truth too often, nearly always below it
    (docs/statistics.md has figures). The mean m of N values of coefficient of variation c is
    taken to be gamma with shape N/c², of which the cube root is nearly normal (Wilson & Hilferty
    1931, PNAS 17): (m/μ)^(1/3) ~ N(1 - v, v), v = c²/(9 N), so that

        μ = m / (1 - v ± q √v)³,

    with q Student's quantile for (N - 1)/(1 + c²) degrees of freedom: of a gamma sample c² is
    known to a relative variance of 2 (1 + c²)/N, not 2/N. For many runs, or little spread, this
    is the t interval. One value gives no interval (-inf, inf); none gives NaN.
    """
    values = values[np.isfinite(values)]
    count, mean = len(values), float(values.mean()) if len(values) else 0.0
    if count < 2 or mean <= 0:
        return mean_interval(values, level)
    squared = float(values.var(ddof=1)) / mean**2
    v = squared / count / 9
    half = float(stats.t.ppf(0.5 + level / 2, (count - 1) / (1 + squared)) * np.sqrt(v))
    low, high = mean / (1 - v + half) ** 3, 1 - v - half
    return Interval(mean, low, mean / high**3 if high > 0 else np.inf)


def chi_square_band(dof: float | Array, runs: float | Array, level: float = 0.95) -> tuple:
    """Bounds between which the mean of `runs` independent chi-square(dof) values lies.

    [χ²((1-level)/2; N dof)/N, χ²((1+level)/2; N dof)/N] (Bar-Shalom et al. 2001, eq. 5.4.2-7).
    For NEES or NIS averaged over the runs **at one step**, where runs are independent.
    """
    total = np.asarray(dof) * np.asarray(runs)
    low, high = (stats.chi2.ppf(0.5 + side * level / 2, total) / runs for side in (-1, 1))
    return (low, high) if np.ndim(total) else (float(low), float(high))


def judge(
    anees: Interval,
    diverged: float,
    tolerance: float = 0.05,
    max_diverged: float = 0.05,
    precision: float = 0.25,
) -> Verdict:
    """The verdict from ANEES/n across runs.

    Consistent means that the interval meets [1 - tolerance, 1 + tolerance]: no significant
    difference from 1, or one too small to matter. With tolerance 0 a truly consistent filter is
    refused with probability 1 - level. Above it the filter's errors are larger than its
    covariance says (overconfident), below it smaller (conservative). An interval that excludes
    nothing because it is wide (few runs, or a few runs with an enormous NEES) is undecided.

    Args:
        anees: ANEES/n with its interval across runs.
        diverged: share of runs that diverged.
        tolerance: half-width of what counts as 1 in practice.
        max_diverged: above this share the word is diverging, whatever the rest do.
        precision: half-width of the interval above which consistent is not said.
    """
    if diverged > max_diverged:
        return Verdict.DIVERGING
    if not np.isfinite([anees.low, anees.high]).all():
        return Verdict.UNDECIDED
    if anees.low > 1 + tolerance:
        return Verdict.OVERCONFIDENT
    if anees.high < 1 - tolerance:
        return Verdict.CONSERVATIVE
    if anees.high - anees.low > 2 * precision:
        return Verdict.UNDECIDED
    return Verdict.CONSISTENT


def diverged_runs(normalized: Array, threshold: float, window: int) -> NDArray[np.bool_]:
    """Runs `(run,)` whose NEES/n `(step, run)` is above a threshold `window` steps in a row."""
    above = normalized > threshold
    window = max(1, min(window, len(above)))
    total = np.concatenate([np.zeros((1, above.shape[1]), np.int64), above.cumsum(axis=0)])
    return (total[window:] - total[:-window] == window).any(axis=0)
