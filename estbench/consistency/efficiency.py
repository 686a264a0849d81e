"""Efficiency: the bound on the mean square error over the mean square error, with its interval.

The bound is known for the first runs only (`bounds.scenario.RUNS`), the error for all. What makes a
run hard counts in both. The interval is that of the logarithm of their ratio by the delta method
(Särndal, Swensson & Wretman 1992, sec. 5.6): each run gives one linearized value, to which the
bound adds only where it is known, and the interval is Student's t interval of their mean, with the
degrees of freedom of Welch (1947, Biometrika 34) where the bound is not known for all runs.
"""

import numpy as np

from estbench.consistency.intervals import NONE, Interval, student_quantile
from estbench.shapes import Array, Float


def by_coordinate(
    bound: Float[Array, "run n"], mse: Float[Array, "run n"], level: float = 0.95
) -> tuple[Interval, ...]:
    """Bound over mean square error of each coordinate; 1 is the best possible.

    Args:
        bound: numbers whose mean over the runs is the bound, (unit)²; NaN where it is not known.
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
    there = np.isfinite(mse).all(axis=1)
    bound, mse = bound[there], mse[there]
    known = np.isfinite(bound).all(axis=1)
    runs, count = len(mse), int(known.sum())
    if not count:
        return NONE
    b, m = bound[known].mean(axis=0), mse.mean(axis=0)
    if not (b > 0).all() or not (m > 0).all():
        return NONE
    excess = m / b
    value = np.log(len(b) / excess.sum())
    if count == 1:
        return Interval(value, -np.inf, np.inf).exponential()
    weight = excess / excess.sum()
    of_bound = np.where(known, (runs / count * (bound / b - 1.0)) @ weight, 0.0)
    of_error = (mse / m - 1.0) @ weight
    spread = (of_bound - of_error).std(ddof=1)
    first, second = of_bound.var(ddof=1), of_error.var(ddof=1)
    size = first**2 / (count - 1) + second**2 / (runs - 1)
    dof = runs - 1 if count == runs or not size else min((first + second) ** 2 / size, runs - 1)
    half = float(student_quantile(level, dof) * spread / np.sqrt(runs))
    return Interval(value, value - half, value + half).exponential()
