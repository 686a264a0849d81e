"""Batched linear algebra on stacks of small matrices; a failure becomes NaN in its own row only.

numpy has no batched triangular solve and scipy's is a Python loop over the stack, so the two
substitutions below are vectorized over the stack and loop over the (small) matrix order.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estbench.shapes import Array

_HALF = np.array(0.5)
"""A Python number would be converted at every call, which is half of it for one small matrix."""


def quiet() -> np.errstate:
    """No warnings of numpy about numbers that are not finite: what fails is marked."""
    return np.errstate(invalid="ignore", over="ignore", divide="ignore")


@lru_cache(maxsize=64)
def identity(n: int) -> Array:
    """I `(n, n)`, made once and read-only: `np.eye` costs a microsecond."""
    eye = np.eye(n)
    eye.flags.writeable = False
    return eye


def pad_absent(cov: Array, mask: NDArray[np.bool_]) -> Array:
    """A covariance with the rows and columns of the identity where nothing arrived `(run, m, m)`.

    So what did not arrive is a reading of its own, uncorrelated with the rest.

    Args:
        cov: `(run, m, m)` or `(m, m)`.
        mask: `(run, m)`, True where a component arrived.
    """
    return np.where(mask[:, :, None] & mask[:, None, :], cov, identity(mask.shape[-1]))


def symmetrize(a: Array) -> Array:
    """(A + Aᵀ)/2 of `(..., n, n)`."""
    return _HALF * (a + a.mT)


def surely_finite(*arrays: Array) -> bool:
    """Whether every number is finite, at a third of `np.isfinite(...).all()`'s cost.

    False may also mean that squares or the sum overflow (above 1e150): ask numpy then.
    """
    # A long dot product would start BLAS threads, which fight with the batches' own.
    for a in arrays:  # noqa: SIM110  (a generator costs as much as the sum)
        if not math.isfinite(np.vdot(a, a) if a.size < 4096 else a.sum()):
            return False
    return True


def cholesky(a: Array) -> Array:
    """Lower Cholesky factors `(run, n, n)`; NaN where a matrix has none.

    numpy raises for the whole stack when one matrix is not positive definite. The stack is then
    halved until the culprits stand alone, so the usual case pays nothing and a failure costs
    O(log run) further calls.
    """
    try:
        lower = np.asarray(np.linalg.cholesky(a), np.float64)
    except np.linalg.LinAlgError:
        good = np.isfinite(a).all(axis=(-2, -1))
        if not good.all():
            out = np.full_like(a, np.nan)
            if good.any():
                out[good] = cholesky(a[good])
            return out
        if len(a) == 1:
            return np.full_like(a, np.nan)
        half = len(a) // 2
        return np.concatenate([cholesky(a[:half]), cholesky(a[half:])])
    if not surely_finite(lower):  # LAPACK lets some infinities and NaNs pass
        lower[~np.isfinite(lower).all(axis=(-2, -1))] = np.nan
    return lower


def solve_lower(lower: Array, b: Array) -> Array:
    """L⁻¹ B by forward substitution; L `(run, m, m)` lower triangular, B `(run, m, k)`."""
    x = np.empty(np.broadcast_shapes(b.shape, (*lower.shape[:-2], 1, 1)))
    for i in range(lower.shape[-1]):
        row = b[..., i, :]
        if i:
            row = row - (lower[..., i : i + 1, :i] @ x[..., :i, :])[..., 0, :]
        np.divide(row, lower[..., i, i, None], out=x[..., i, :])
    return x


def solve_lower_transposed(lower: Array, b: Array) -> Array:
    """L⁻ᵀ B by back substitution; L `(run, m, m)` lower triangular, B `(run, m, k)`."""
    x = np.empty(np.broadcast_shapes(b.shape, (*lower.shape[:-2], 1, 1)))
    m = lower.shape[-1]
    for i in reversed(range(m)):
        row = b[..., i, :]
        if i + 1 < m:
            row = row - (lower[..., None, i + 1 :, i] @ x[..., i + 1 :, :])[..., 0, :]
        np.divide(row, lower[..., i, i, None], out=x[..., i, :])
    return x


def row_product(rows: Array, factor: Array) -> Array:
    """Each row v of `(run, k)` as F v `(run, n)`, for F `(n, k)`.

    BLAS rounds the product of one row otherwise than that of many: one row is taken twice.
    """
    if len(rows) == 1:
        return (rows.repeat(2, axis=0) @ factor.T)[:1]
    return rows @ factor.T


def weighted(weights: Array, points: Array) -> Array:
    """Σ wᵢ pᵢ `(..., k)` for weights `(point,)` or `(..., point)` and points `(..., point, k)`."""
    return weights @ points if weights.ndim == 1 else (weights[..., None, :] @ points)[..., 0, :]


def quadratic_form(cov: Array, v: Array) -> Array:
    """vᵀ P⁻¹ v `(run,)` for P `(run, n, n)`, v `(run, n)`; NaN where P has no Cholesky factor."""
    white = solve_lower(cholesky(cov), v[..., None])[..., 0]
    return np.vecdot(white, white)


def psd_factor(a: Array) -> Array:
    """A square root S `(n, n)` with S Sᵀ = A for one symmetric positive semidefinite A.

    By eigenvalues, since a process noise is often singular (no noise on the positions).
    """
    values, vectors = np.linalg.eigh(symmetrize(a))
    return vectors * np.sqrt(np.clip(values, 0.0, None))


def rescaled(a: Array, value: float | Array) -> Array:
    """A covariance A `(n, n)` by what it is to be times: D A D, or the value itself if a matrix.

    Args:
        a: the covariance.
        value: D, one number or one a coordinate `(n,)`; or what is in the place of A `(n, n)`.
    """
    if np.ndim(value) == 2:
        return np.asarray(value)
    size = np.broadcast_to(value, a.shape[:1])
    return a * np.outer(size, size)


def is_positive_semidefinite(a: Array) -> bool:
    """Whether one matrix `(n, n)` is symmetric without negative eigenvalues, but for rounding."""
    if not (np.isfinite(a).all() and np.allclose(a, a.T)):
        return False
    smallest = np.linalg.eigvalsh(a).min(initial=0.0)
    return bool(smallest >= -1e-12 * max(1.0, np.abs(a).max(initial=0.0)))


def is_positive_definite(a: Array) -> bool:
    """Whether one symmetric matrix `(n, n)` has a Cholesky factor."""
    return bool(np.isfinite(cholesky(a[None])).all() and np.allclose(a, a.T, rtol=1e-9, atol=0))
