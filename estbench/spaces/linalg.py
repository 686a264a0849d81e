"""Batched linear algebra on stacks of small matrices; a row that fails becomes NaN, others do not.

numpy has no batched triangular solve and scipy's is a Python loop over the stack, so the two
substitutions below are vectorized over the stack and loop over the (small) matrix order.
"""

import math
from functools import lru_cache

import numpy as np

from estbench.shapes import Array, Bool, Float, Mask


def quiet() -> np.errstate:
    """Suppress numpy's warnings about numbers that are not finite: such rows are marked failed."""
    return np.errstate(invalid="ignore", over="ignore", divide="ignore")


@lru_cache(maxsize=64)
def identity(n: int) -> Float[Array, "n n"]:
    """I, cached and read-only: `np.eye` costs a microsecond."""
    eye = np.eye(n)
    eye.flags.writeable = False
    return eye


@lru_cache(maxsize=64)
def constant(value: float) -> Float[Array, ""]:
    """A number as an array: a Python number would be converted at every call of numpy."""
    out = np.array(value)
    out.flags.writeable = False
    return out


def pad_absent(cov: Float[Array, "*any m m"], mask: Bool[Mask, "run m"]) -> Float[Array, "run m m"]:
    """A covariance with the rows and columns of the identity where no component arrived.

    A component that did not arrive then has variance 1 and no correlation with the others.

    Args:
        cov: one covariance, or one per run.
        mask: True where a component arrived.
    """
    return np.where(mask[:, :, None] & mask[:, None, :], cov, identity(mask.shape[-1]))


def symmetrize(a: Float[Array, "*any n n"]) -> Float[Array, "*any n n"]:
    """(A + Aᵀ)/2."""
    return constant(0.5) * (a + a.mT)


def surely_finite(*arrays: Array) -> bool:
    """Whether every number is finite, at a third of the cost of `np.isfinite(...).all()`.

    False may also mean that the squares or the sum overflow (above 1e150): then use `np.isfinite`.
    """
    # A long dot product would start BLAS threads, which compete with those of the batches.
    for a in arrays:  # noqa: SIM110  (a generator costs as much as the sum)
        if not math.isfinite(np.vdot(a, a) if a.size < 4096 else a.sum()):
            return False
    return True


def cholesky(a: Float[Array, "run n n"]) -> Float[Array, "run n n"]:
    """Lower Cholesky factors; NaN where a matrix has none.

    numpy raises for the whole stack when one matrix is not positive definite. The stack is then
    halved until each such matrix is alone. A stack without failures costs nothing more; each
    failure costs O(log run) further calls.
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


def solve_lower(
    lower: Float[Array, "*any m m"], b: Float[Array, "*other m k"]
) -> Float[Array, "... m k"]:
    """L⁻¹ B by forward substitution, for a lower triangular L."""
    x = _solution(lower, b)
    for i in range(lower.shape[-1]):
        row = b[..., i, :]
        if i:
            row = row - (lower[..., i : i + 1, :i] @ x[..., :i, :])[..., 0, :]
        np.divide(row, lower[..., i, i, None], out=x[..., i, :])
    return x


def solve_lower_transposed(
    lower: Float[Array, "*any m m"], b: Float[Array, "*other m k"]
) -> Float[Array, "... m k"]:
    """L⁻ᵀ B by back substitution, for a lower triangular L."""
    x = _solution(lower, b)
    m = lower.shape[-1]
    for i in reversed(range(m)):
        row = b[..., i, :]
        if i + 1 < m:
            row = row - (lower[..., None, i + 1 :, i] @ x[..., i + 1 :, :])[..., 0, :]
        np.divide(row, lower[..., i, i, None], out=x[..., i, :])
    return x


def _solution(lower: Array, b: Array) -> Array:
    """An empty array for L⁻¹ B."""
    if lower.shape[:-2] == b.shape[:-2]:
        return np.empty(b.shape)
    return np.empty(np.broadcast_shapes(b.shape, (*lower.shape[:-2], 1, 1)))


def solve_one_lower(lower: Float[Array, "m m"], b: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """L⁻¹ B for one lower triangular L, in one call of LAPACK.

    By `gesv`: in reverse order L is upper triangular, so that its LU factors are I and the matrix
    itself. OpenBLAS's `trtrs` and `trsm` wake all threads at nearly any size: a product of 4 x 4
    takes 2 µs on an idle machine and 8 ms where the cores are busy.
    """
    return np.asarray(np.linalg.solve(lower[::-1, ::-1], b[::-1])[::-1], np.float64)


def row_product(rows: Float[Array, "run k"], factor: Float[Array, "n k"]) -> Float[Array, "run n"]:
    """F v for each row v.

    BLAS rounds the product of a single row differently from that of several rows: a single row is
    therefore multiplied as two equal rows.
    """
    if len(rows) == 1:
        return (rows.repeat(2, axis=0) @ factor.T)[:1]
    return rows @ factor.T


def weighted(
    weights: Float[Array, "... point"], points: Float[Array, "*any point k"]
) -> Float[Array, "*any k"]:
    """Σ wᵢ pᵢ, with one set of weights `(point,)` or one per stack `(..., point)`."""
    return weights @ points if weights.ndim == 1 else (weights[..., None, :] @ points)[..., 0, :]


def quadratic_form(
    cov: Float[Array, "*any n n"], v: Float[Array, "*any n"]
) -> Float[Array, "*any"]:
    """vᵀ P⁻¹ v; NaN where P has no Cholesky factor."""
    white = solve_lower(cholesky(cov), v[..., None])[..., 0]
    return np.vecdot(white, white)


def rescaled(a: Float[Array, "n n"], value: float | Array) -> Float[Array, "n n"]:
    """The covariance D A D with a diagonal D, or another covariance in place of A.

    Args:
        a: the covariance A.
        value: the diagonal of D, one number or one per coordinate `(n,)`; or the covariance
            `(n, n)` that replaces A.
    """
    if np.ndim(value) == 2:
        return np.asarray(value)
    size = np.broadcast_to(value, a.shape[:1])
    return a * np.outer(size, size)


def is_positive_semidefinite(a: Float[Array, "n n"]) -> bool:
    """Whether one matrix is symmetric and has no negative eigenvalue beyond rounding errors."""
    if not (np.isfinite(a).all() and np.allclose(a, a.T)):
        return False
    smallest = np.linalg.eigvalsh(a).min(initial=0.0)
    return bool(smallest >= -1e-12 * max(1.0, np.abs(a).max(initial=0.0)))


def is_positive_definite(a: Float[Array, "n n"]) -> bool:
    """Whether one symmetric matrix has a Cholesky factor."""
    return bool(np.isfinite(cholesky(a[None])).all() and np.allclose(a, a.T, rtol=1e-9, atol=0))


def added_first(u: Float[Array, "*lead width"], w: Float[Array, "*some k"]) -> Array:
    """Sum of u and w, which has the first k components and is broadcast as in a sum."""
    more = u.shape[-1] - w.shape[-1]
    if not more:
        return u + w
    return u + np.concatenate([w, np.zeros((*w.shape[:-1], more))], axis=-1)
