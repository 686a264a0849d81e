"""NEES and NIS: their chi-square bands, and divergence.

NEES is (x ⊖ x̂)ᵀ P⁻¹ (x ⊖ x̂), NIS is νᵀ S⁻¹ ν; for a consistent filter they are chi-square with n
and m degrees of freedom (Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4; source 002).
"""

from typing import Any

import numpy as np
import scipy  # imports its statistics at their first use; a worker has none
from numpy.typing import NDArray

from estbench.shapes import Array, Bool, Float, Mask, Shaped


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
    low, high = (scipy.stats.chi2.ppf(0.5 + side * level / 2, total) / runs for side in (-1, 1))
    return (low, high) if np.ndim(total) else (float(low), float(high))


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
    return lasting(above, max(1, min(window, len(above))))


def lasting(above: Bool[Mask, "step run"], window: int) -> Bool[Mask, " run"]:
    """Runs with `window` consecutive steps that are True; none where there are fewer steps."""
    total = np.concatenate([np.zeros((1, above.shape[1]), np.int64), above.cumsum(axis=0)])
    return (total[window:] - total[:-window] == window).any(axis=0)
