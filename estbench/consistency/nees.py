"""Is an estimator's covariance to be trusted? NEES, NIS, their chi-square bands, and a verdict.

NEES is (x ⊖ x̂)ᵀ P⁻¹ (x ⊖ x̂), NIS is νᵀ S⁻¹ ν; for a consistent filter they are chi-square with n
and m degrees of freedom (Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4; source 002).
"""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from estbench.consistency.intervals import Interval
from estbench.shapes import Array


class Verdict(StrEnum):
    """What the NEES says, in a word."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    CONSERVATIVE = "conservative"
    DIVERGING = "diverging"
    UNDECIDED = "undecided"


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
