"""Skewness of an error over time and runs, with the jackknife's interval across runs."""

import numpy as np

from estbench.consistency.intervals import NONE, Interval, student_quantile
from estbench.shapes import Array, Float


def skewness(
    moments: Float[Array, "... 3"],
) -> Float[Array, "..."]:
    """E[(e - Ee)³] / Var(e)^(3/2) from the moments E e, E e², E e³; NaN without a variance."""
    mean, square, cube = np.moveaxis(moments, -1, 0)
    variance = square - mean**2
    third = cube - 3 * mean * square + 2 * mean**3
    positive = variance > 1e-12 * square
    return np.where(positive, third / np.where(positive, variance, 1.0) ** 1.5, np.nan)


def skewness_interval(moments: Float[Array, "run 3"], level: float = 0.95) -> Interval:
    """Skewness with the jackknife's interval (Efron & Tibshirani 1993, ch. 11).

        s² = (N - 1)/N Σᵢ (g₍ᵢ₎ - ḡ)²,    g ± t(N - 1) s,

    g of all runs, g₍ᵢ₎ of all but the i-th, ḡ the mean of the latter.

    Args:
        moments: averages over time of e, e² and e³ of each run; a run with one that is not finite
            is left out.
        level: confidence.

    Returns:
        NaN without runs or without a variance; no interval (-inf, inf) from fewer than three runs.
    """
    moments = moments[np.isfinite(moments).all(axis=-1)]
    count = len(moments)
    if count == 0:
        return NONE
    total = moments.sum(axis=0)
    value = float(skewness(total / count))
    if count < 3 or np.isnan(value):
        return Interval(value, -np.inf, np.inf) if np.isfinite(value) else NONE
    left = skewness((total - moments) / (count - 1))
    spread = np.sqrt((count - 1) / count * ((left - left.mean()) ** 2).sum())
    half = float(student_quantile(level, count - 1) * spread)
    return Interval(value, value - half, value + half)
