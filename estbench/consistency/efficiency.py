"""Efficiency: the bound on the mean square error over the mean square error, with its interval.

Both are means over the same runs, so that what makes a run hard counts in both. The interval is
that of the logarithm of their ratio by the delta method (Särndal, Swensson & Wretman 1992, sec.
5.6): each run gives one linearized value, and Student's t interval is that of their mean.
"""

import numpy as np

from estbench.consistency.intervals import NONE, Interval, mean_interval
from estbench.shapes import Array, Float


def by_coordinate(
    bound: Float[Array, "run n"], mse: Float[Array, "run n"], level: float = 0.95
) -> tuple[Interval, ...]:
    """Bound over mean square error of each coordinate; 1 is the best possible.

    Args:
        bound: numbers whose mean over the runs is the bound, (unit)².
        mse: squared errors, averaged over time, (unit)².
        level: confidence.

    Returns:
        NaN for each coordinate without a bound.
    """
    return tuple(together(b[:, None], m[:, None], level) for b, m in zip(bound.T, mse.T))


def together(
    bound: Float[Array, "run n"], mse: Float[Array, "run n"], level: float = 0.95
) -> Interval:
    """N / Σ (mean square error / bound): all coordinates, each in units of its bound.

    It is the harmonic mean of the coordinates' efficiencies, and so at most n times the lowest: a
    single bad coordinate is not hidden by good ones. The arguments are those of `by_coordinate`.
    """
    known = np.isfinite(bound).all(axis=1) & np.isfinite(mse).all(axis=1)
    bound, mse = bound[known], mse[known]
    if not len(bound):
        return NONE
    b, m = bound.mean(axis=0), mse.mean(axis=0)
    if not (b > 0).all() or not (m > 0).all():
        return NONE
    excess = m / b
    total = excess.sum()
    linear = (excess * (bound / b - mse / m)).sum(axis=1) / total
    return mean_interval(np.log(len(b) / total) + linear, level).exponential()
