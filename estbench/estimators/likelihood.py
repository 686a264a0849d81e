"""The log-likelihood of a measurement, from its innovation: prediction error decomposition."""

from typing import Any

import numpy as np

from estbench.estimators.protocol import Innovation
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.spaces.linalg import cholesky, pad_absent

LOG_TWO_PI = float(np.log(2.0 * np.pi))


def log_likelihood(
    innovation: Innovation | Any, mask: Bool[Mask, "run m"] | None = None
) -> Float[Array, " run"]:
    """Log p(y | earlier readings) of each run.

        log N(ν; 0, S) = -(νᵀS⁻¹ν + log det S + m log 2π)/2

    unless the estimator states its own. The sum over the updates is the log-likelihood of a model
    (Schweppe 1965, IEEE Trans. Inf. Theory 11; Särkkä & Svensson 2023, ch. 16). A component that
    did not arrive has unit variance in S and is not counted in m, so that it contributes nothing.

    Args:
        innovation: of one update; that of an estimator outside of this package may lack S.
        mask: True where a component arrived; None if all did. Needed for an S that has not the rows
            of the identity where nothing arrived.

    Returns:
        NaN without S, or where S has no Cholesky factor.
    """
    stated = getattr(innovation, "log_likelihood", None)
    if stated is not None:
        return stated
    factor = getattr(innovation, "factor", None)
    if factor is None:
        cov = np.asarray(getattr(innovation, "cov", ()))
        if not cov.size:
            return np.full(np.shape(innovation.nis), np.nan)
        if mask is not None:
            cov = pad_absent(cov, mask)
        factor = cholesky(cov if cov.ndim == 3 else cov[None])
    return -0.5 * innovation.nis - log_normalization(factor, innovation.dof)


def log_normalization(
    factor: Float[Array, "... m m"], dof: Int[Ints, " run"]
) -> Float[Array, " run"]:
    """(log det L Lᵀ + m log 2π)/2.

    Args:
        factor: L, with the rows of the identity where a component did not arrive.
        dof: m, the count of those that arrived.
    """
    diagonal = np.diagonal(factor, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(diagonal).sum(axis=-1) + 0.5 * LOG_TWO_PI * dof
