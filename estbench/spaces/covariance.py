"""Whether given matrices are covariances: finite, symmetric, without negative eigenvalues."""

import numpy as np

from estbench.errors import CovarianceError
from estbench.shapes import Array, Bool, Float, Mask

_ROUNDING = 1e-9
"""Of a correlation: how far rounding errors may take a matrix from symmetry, an eigenvalue below 0.
"""


def check_covariance(
    name: str, cov: Float[Array, "*any n n"], definite: bool = False, when: str = ""
) -> None:
    """Refuse a stack of matrices of which one is no covariance.

    Args:
        name: what it is, for the message.
        cov: one matrix, or several.
        definite: whether eigenvalues of 0 are refused too.
        when: a further part of the message.

    Raises:
        CovarianceError: a matrix is not finite, not symmetric to rounding, or has a negative
            eigenvalue beyond rounding; the message names the entry or the eigenvalue, and which
            matrix it is where there are several.
    """
    stack = cov.reshape(-1, *cov.shape[-2:])
    finite = np.isfinite(stack).all(axis=(1, 2))
    even = finite & ~asymmetric(np.where(finite[:, None, None], stack, 0.0), _ROUNDING)
    smallest = _smallest(np.where(even[:, None, None], stack, 0.0))
    good = even & ((smallest > 1e-14) if definite else (smallest >= -_ROUNDING))
    if good.all():
        return
    worst = int(good.argmin())
    matrix = stack[worst]
    if not finite[worst]:
        i, j = np.argwhere(~np.isfinite(matrix))[0]
        reason = f"entry [{i}, {j}] is {matrix[i, j]:g}"
    elif not even[worst]:
        i, j = np.unravel_index(np.abs(matrix - matrix.T).argmax(), matrix.shape)
        reason = f"entry [{i}, {j}] is {matrix[i, j]:g} and [{j}, {i}] is {matrix[j, i]:g}"
    else:
        value = np.linalg.eigvalsh(matrix).min()
        reason = f"its smallest eigenvalue is {value:.3g}; raise its eigenvalues"
    which = f" of run {worst}" if len(stack) > 1 else ""
    kind = "definite" if definite else "semidefinite"
    raise CovarianceError(f"{name}{which} is not symmetric positive {kind}{when}: {reason}")


def asymmetric(cov: Float[Array, "row n n"], tolerance: float) -> Bool[Mask, " row"]:
    """Where |Pᵢⱼ - Pⱼᵢ| exceeds `tolerance` σᵢ σⱼ; False for a matrix that is not finite."""
    skew = np.abs(cov - cov.mT)
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    rounding = 1e-15 * np.abs(cov).max(axis=(-2, -1), initial=0.0)[:, None, None]
    beyond = skew > tolerance * std[:, :, None] * std[:, None, :] + rounding
    return np.asarray(beyond.any(axis=(-2, -1)))


def _smallest(cov: Array) -> Array:
    """The smallest eigenvalue `(row,)` of each matrix with its coordinates scaled to variance 1.

    A negative variance stays -1. So rounding errors of a large coordinate do not hide a small one.
    """
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    std = np.sqrt(np.where(variance == 0, 1.0, np.abs(variance)))
    scaled = cov / (std[:, :, None] * std[:, None, :])
    return np.linalg.eigvalsh(0.5 * (scaled + scaled.mT)).min(axis=-1, initial=np.inf)
