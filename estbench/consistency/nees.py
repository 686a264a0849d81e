"""NEES and NIS: their chi-square bands, divergence, and the verdict on the covariance.

NEES is (x ⊖ x̂)ᵀ P⁻¹ (x ⊖ x̂), NIS is νᵀ S⁻¹ ν; for a consistent filter they are chi-square with n
and m degrees of freedom (Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4; source 002).
"""

from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from estbench.consistency.intervals import Interval
from estbench.shapes import Array, Bool, Float, Mask, Shaped


class Verdict(StrEnum):
    """The verdict, in a word."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    CONSERVATIVE = "conservative"
    DIVERGING = "diverging"
    UNDECIDED = "undecided"


def chi_square_band(
    dof: float | Shaped[NDArray[Any], "*#any"],
    runs: float | Shaped[NDArray[Any], "*#any"],
    level: float = 0.95,
) -> tuple:
    """Bounds between which the mean of `runs` independent chi-square(dof) values lies.

    [χ²((1-level)/2; N dof)/N, χ²((1+level)/2; N dof)/N] (Bar-Shalom et al. 2001, eq. 5.4.2-7).
    For NEES or NIS averaged over the runs **at one step**, where runs are independent.

    Args:
        dof: degrees of freedom of one value.
        runs: N.
        level: probability.

    Returns:
        Lower and upper bound, floats or `(...)`.
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

    Consistent: the interval overlaps [1 - tolerance, 1 + tolerance], so that the difference from 1
    is not significant, or too small to matter. With tolerance 0 a consistent filter is refused
    with probability 1 - level. Overconfident: the interval is above, the errors are larger than
    the covariance says. Conservative: it is below, they are smaller. Undecided: the interval
    overlaps and is too wide, as with few runs, or some runs with an enormous NEES.

    Args:
        anees: ANEES/n with its interval across runs.
        diverged: share of runs that diverged.
        tolerance: a difference of ANEES/n from 1 that does not matter.
        max_diverged: with a larger share the verdict is diverging, whatever ANEES/n is.
        precision: half-width of the interval above which the verdict is not consistent.
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


def diverged_runs(
    normalized: Float[Array, "step run"], threshold: float, window: int
) -> Bool[Mask, " run"]:
    """Runs whose NEES/n is above a threshold for `window` consecutive steps.

    Args:
        normalized: NEES/n.
        threshold: of NEES/n.
        window: steps, at least 1; more than there are count as all.
    """
    above = normalized > threshold
    window = max(1, min(window, len(above)))
    total = np.concatenate([np.zeros((1, above.shape[1]), np.int64), above.cumsum(axis=0)])
    return (total[window:] - total[:-window] == window).any(axis=0)
