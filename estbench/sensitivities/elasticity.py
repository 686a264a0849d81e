"""Elasticities d log y / d log θ from the same runs at two values of θ."""

import numpy as np

from estbench.consistency.fields import Record
from estbench.consistency.intervals import NONE, Interval, mean_interval
from estbench.shapes import Array, Float


def elasticity(
    low: Float[Array, "run k"], high: Float[Array, "run k"], ratio: float, level: float
) -> Interval:
    """The elasticity of the geometric mean over k of means over runs, with its interval.

        ε = Σ_k (log ȳ_k(θ₂) - log ȳ_k(θ₁)) / (k log θ₂/θ₁)

    The interval is that of the differences of paired runs (delta method): run i contributes
    y_ik(θ₂)/ȳ_k(θ₂) - y_ik(θ₁)/ȳ_k(θ₁), of which what the runs have in common cancels.

    Args:
        low: positive values of each run at θ₁.
        high: those at θ₂.
        ratio: θ₂/θ₁, not 1.
        level: confidence.

    Returns:
        NaN where there is no run, or a mean is zero.
    """
    if not low.size:
        return NONE
    means = low.mean(axis=0), high.mean(axis=0)
    if not (np.stack(means) > 0).all():
        return NONE
    slope = np.log(means[1] / means[0]).mean() / np.log(ratio)
    shares = (high / means[1] - low / means[0]).mean(axis=1) / np.log(ratio)
    spread = mean_interval(shares, level)
    half = (spread.high - spread.low) / 2
    return Interval(float(slope), float(slope - half), float(slope + half))


def of_records(
    low: Record, high: Record, ratio: float, level: float
) -> tuple[Interval, Interval, tuple[Interval, ...], int]:
    """Elasticities of RMSE, of NEES, and of each coordinate's RMSE.

    Of the runs that diverged at neither value. RMSE is the geometric mean over the coordinates
    whose error is not zero.

    Args:
        low: record at the first value of θ.
        high: record of the same runs at the second value.
        ratio: of the values of θ.
        level: confidence.

    Returns:
        The three, and how many runs were left out.
    """
    good = ~(low["diverged"].astype(bool) | high["diverged"].astype(bool))
    for record in (low, high):
        good &= np.isfinite(record["mse"]).all(axis=1)
    a, b = low["mse"][good], high["mse"][good]
    moved = (a.any(axis=0) & b.any(axis=0)) if len(a) else np.zeros(a.shape[1], bool)
    known = good & np.isfinite(low["anees"]) & np.isfinite(high["anees"])
    nees = elasticity(low["anees"][known, None], high["anees"][known, None], ratio, level)
    rmse = elasticity(a[:, moved], b[:, moved], ratio, level).scaled(0.5)
    each = tuple(
        elasticity(a[:, [i]], b[:, [i]], ratio, level).scaled(0.5) for i in range(a.shape[1])
    )
    return rmse, nees, each, int((~good).sum())


def size(record: Record) -> tuple[float, float]:
    """RMSE (geometric mean over the coordinates) and NEES/n of the runs that did not diverge."""
    good = ~record["diverged"].astype(bool)
    mse = record["mse"][good].mean(axis=0) if good.any() else np.full(1, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        rmse = float(np.exp(0.5 * np.log(mse[~(mse == 0)]).mean())) if mse.any() else 0.0
    nees = record["anees"][good]
    nees = nees[np.isfinite(nees)]
    return rmse, float(nees.mean()) if len(nees) else np.nan
