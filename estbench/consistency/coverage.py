"""Share of the errors within 1, 2 and 3 standard deviations that the filter reports."""

from dataclasses import dataclass

import numpy as np
from scipy import special

from estbench.consistency.intervals import Interval, mean_interval
from estbench.consistency.sums import Mean
from estbench.shapes import Array, Float

SIGMAS = (1, 2, 3)
EXPECTED = tuple(float(special.erf(k / np.sqrt(2))) for k in SIGMAS)
"""Shares of normal errors: 0.683, 0.954, 0.997."""


def inside(error: Float[Array, "step run n"], std: Float[Array, "step run n"]) -> Mean:
    """Share of the steps at which |error| <= kσ, k = 1, 2, 3 `(run, n, 3)`.

    NaN where no step counts.

    A step whose error or σ is not finite counts as outside. A step at which the coordinate is known
    exactly does not count.

    Args:
        error: x ⊖ x̂.
        std: σ that the filter reports; 0 where the coordinate is known exactly.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(std == 0, np.nan, np.abs(error) / std)
        count = np.count_nonzero(std != 0, axis=0)
        found = np.stack([(ratio <= k).sum(axis=0) for k in SIGMAS], axis=-1)
    return Mean(found, count[..., None])


@dataclass(frozen=True)
class Coverage:
    """Coverage of one coordinate, or of the coordinates of one unit together.

    Attributes:
        shares: within 1, 2 and 3σ, with intervals across runs.
    """

    shares: tuple[Interval, ...]

    @property
    def as_expected(self) -> tuple[bool, ...]:
        """Whether each interval contains the share of normal errors."""
        return tuple(e in i for e, i in zip(EXPECTED, self.shares))


def coverage(shares: Float[Array, "run ... 3"], level: float = 0.95) -> Coverage:
    """Mean share over the runs with Student's t interval, cut to [0, 1].

    Steps of one run are correlated, so the spread is taken across runs.

    Args:
        shares: `(run, 3)` of one coordinate, or `(run, coordinate, 3)` of several, which are
            averaged; NaN is left out.
        level: confidence.
    """
    each = shares
    if shares.ndim == 3:
        some = np.isfinite(shares)
        count = np.maximum(some.sum(axis=1), 1)
        each = np.where(some.any(axis=1), np.where(some, shares, 0.0).sum(axis=1) / count, np.nan)
    found = (mean_interval(column, level) for column in each.T)
    return Coverage(tuple(Interval(i.value, max(i.low, 0.0), min(i.high, 1.0)) for i in found))
