"""Ljung-Box test of the whiteness of innovations of any dimension.

With S = L Lᵀ the whitened innovations ν̃ = L⁻¹ν of a consistent filter are independent N(0, I).
Those of a filter that does not use all information, as with too small a Q, are correlated in time.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # imports its statistics at their first use; a worker has none

from estbench.consistency.intervals import Interval, mean_interval, wilson
from estbench.inference.lags import correlation
from estbench.shapes import Array, Float, Int, Ints


def portmanteau(
    products: Float[Array, "*any lag"], terms: Int[Ints, "*any lag"]
) -> float | Float[Array, "*any"]:
    """Ljung & Box's statistic, chi-square with `lag` degrees of freedom if white.

        Q = (N + 2)/N Σₗ Nₗ ρₗ²,    ρₗ = (Sₗ/Nₗ) / (S₀/N₀),    l = 1 ... h

    Sₗ sums the scalar products ν̃ₖ·ν̃ₖ₋ₗ, Nₗ counts their terms, N = N₀ (Ljung & Box 1978,
    Biometrika 65; there m = 1, Nₗ = N - l and ρₗ is divided by N). In m dimensions Sₗ is the trace
    of the lagged m x m product, a sum of Nₗ ≈ m (K - l) uncorrelated terms, so that each lag has
    **one** degree of freedom; all m² elements would have m² of them (Hosking 1980, JASA 75), and
    need m² numbers per lag. No degree of freedom is subtracted: no coefficient is fitted to the
    innovations, and their mean is 0 by hypothesis.

    Args:
        products: Sₗ, lag 0 first.
        terms: Nₗ; a lag without terms is left out.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(terms > 0, correlation(products, terms), 0.0)
        total = terms[..., 0]
        return (total + 2) / total * (terms * rho**2)[..., 1:].sum(axis=-1)


@dataclass(frozen=True)
class Whiteness:
    """Autocorrelation of the whitened innovations, and Ljung and Box's test of it.

    Attributes:
        correlation: of each lag from 1, with Student's t interval across runs.
        rejected: share of the runs whose innovations are not white at the level; for a white
            filter 1 - level is expected and the interval contains it.
        p: p-value of the test of all runs together; with many runs it detects deviations that are
            too small to matter.
    """

    correlation: tuple[Interval, ...]
    rejected: Interval
    p: float


def whiteness(
    products: Float[Array, "run lag"], terms: Int[Ints, "run lag"], level: float = 0.95
) -> Whiteness | None:
    """Whiteness of the innovations, or None where no run has two of them.

    Args:
        products: sums of ν̃ₖ·ν̃ₖ₋ₗ of each run, lag 0 first.
        terms: count of the scalar products in each sum.
        level: confidence; each run is tested at 1 - level.
    """
    used = np.isfinite(products).all(axis=-1) & (terms[:, 1:] > 0).any(axis=-1)
    products, terms = products[used], terms[used]
    if not used.any():
        return None
    dof = (terms[:, 1:] > 0).sum(axis=-1)
    rejected = scipy.stats.chi2.sf(portmanteau(products, terms), dof) < 1 - level
    pooled = products.sum(axis=0), terms.sum(axis=0)
    each = correlation(products, terms)[:, 1:]
    return Whiteness(
        correlation=tuple(mean_interval(column, level) for column in each.T),
        rejected=wilson(int(rejected.sum()), len(rejected), level),
        p=float(scipy.stats.chi2.sf(portmanteau(*pooled), int((pooled[1][1:] > 0).sum()))),
    )
