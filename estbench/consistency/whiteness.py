"""Are the innovations white? Ljung-Box on whitened innovations of any dimension.

With S = L Lᵀ the innovations ν̃ = L⁻¹ν of a consistent filter are independent N(0, I). A filter that
leaves information in them, as one with too small a Q does, has them correlated over time.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from estbench.consistency.intervals import Interval, mean_interval, wilson
from estbench.inference.lags import correlation
from estbench.shapes import Array


def portmanteau(products: Array, terms: NDArray[Any]) -> Array:
    """Ljung & Box's statistic `(...)`, chi-square with `lag` degrees of freedom if white.

        Q = (N + 2)/N Σₗ Nₗ ρₗ²,    ρₗ = (Sₗ/Nₗ) / (S₀/N₀),    l = 1 ... h

    Sₗ sums the scalar products ν̃ₖ·ν̃ₖ₋ₗ, Nₗ counts their terms, N = N₀ (Ljung & Box 1978,
    Biometrika 65; there m = 1, Nₗ = N - l and ρₗ is divided by N). In m dimensions Sₗ is the trace
    of the lagged m x m product, a sum of Nₗ ≈ m (K - l) uncorrelated terms, so that each lag has
    **one** degree of freedom; all m² elements would have m² of them (Hosking 1980, JASA 75), and
    need m² numbers a lag. Nothing is taken off: no coefficient is fitted to the innovations, and
    their mean is 0 by hypothesis.

    Args:
        products: Sₗ `(..., h + 1)`, lag 0 first.
        terms: Nₗ, the same shape; a lag without terms does not count.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(terms > 0, correlation(products, terms), 0.0)
        total = terms[..., 0]
        return (total + 2) / total * (terms * rho**2)[..., 1:].sum(axis=-1)


@dataclass(frozen=True)
class Whiteness:
    """What the autocorrelation of the innovations says.

    Attributes:
        correlation: of each lag from 1, with Student's t interval across runs.
        rejected: share of the runs whose own innovations are not white at the level; 1 - level of
            them are expected, so the interval of a white filter holds it.
        p: of the pooled test over all runs; with many runs it finds deviations too small to matter.
    """

    correlation: tuple[Interval, ...]
    rejected: Interval
    p: float


def whiteness(products: Array, terms: NDArray[Any], level: float = 0.95) -> Whiteness | None:
    """Whiteness of runs' innovations, or None where there are no two of them in a run.

    Args:
        products: sums of ν̃ₖ·ν̃ₖ₋ₗ of each run `(run, h + 1)`.
        terms: how many scalar products each has, the same shape.
        level: confidence; each run is tested at 1 - level.
    """
    used = np.isfinite(products).all(axis=-1) & (terms[:, 1:] > 0).any(axis=-1)
    products, terms = products[used], terms[used]
    if not used.any():
        return None
    dof = (terms[:, 1:] > 0).sum(axis=-1)
    rejected = stats.chi2.sf(portmanteau(products, terms), dof) < 1 - level
    pooled = products.sum(axis=0), terms.sum(axis=0)
    each = correlation(products, terms)[:, 1:]
    return Whiteness(
        correlation=tuple(mean_interval(column, level) for column in each.T),
        rejected=wilson(int(rejected.sum()), len(rejected), level),
        p=float(stats.chi2.sf(portmanteau(*pooled), int((pooled[1][1:] > 0).sum()))),
    )
