"""The prior that a user gives: x̂₀ and P₀ of every run, checked."""

from typing import Any

import numpy as np

from estbench.errors import DimensionError
from estbench.estimators.beliefs import check_prior
from estbench.models.calls import numbers
from estbench.shapes import Array, Float
from estbench.spaces.covariance import check_covariance
from estbench.spaces.manifold import Manifold


def real(what: str, given: Any, expected: str) -> Array:
    """As `models.calls.numbers`; float32 is taken too, since nothing is differentiated."""
    if getattr(getattr(given, "dtype", None), "kind", "") == "f" and type(given) is np.ndarray:
        return given.astype(np.float64, copy=False)
    return numbers(what, given, expected)


def checked_prior(
    mean: Any, cov: Any, space: Manifold | None = None
) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
    """x̂₀ and P₀ as arrays.

    Args:
        mean: x̂₀ `(run, nx)`.
        cov: P₀ `(run, n, n)`.
        space: the state space, if it is known.

    Raises:
        DimensionError: they are no finite real numbers (complex, masked, NaN), or do not fit.
        CovarianceError: P₀ of a run is not symmetric, or has a negative eigenvalue.
    """
    mean = real("mean is", mean, "x̂₀ of shape (run, nx)")
    cov = real("cov is", cov, "P₀ of shape (run, n, n)")
    if mean.ndim != 2 or cov.ndim != 3:
        raise DimensionError(
            f"mean has shape {mean.shape} and cov {cov.shape}; expected (run, nx), (run, n, n)"
        )
    check_prior(space, mean, cov)
    bad = np.argwhere(~np.isfinite(mean))
    if len(bad):
        run, i = bad[0]
        raise DimensionError(f"mean is {mean[run, i]:g} in run {run}, coordinate {i}; give numbers")
    check_covariance("cov (P₀)", cov)
    return mean, cov
