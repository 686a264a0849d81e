"""Positive semidefinite covariances: a square root, and the quadratic form on the range.

P is singular where a coordinate, or a combination of coordinates, is known exactly. Which
variance counts as zero is decided by scale, so that units do not matter:

- a coordinate is known exactly where its standard deviation is at most its resolution, the
  rounding error of its value;
- a combination of the other coordinates is, where its eigenvalue in their correlation matrix is at
  most `ROUNDING`, or its standard deviation at most the resolutions of its coordinates.
"""

from dataclasses import dataclass

import numpy as np

from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.spaces.linalg import cholesky, identity, solve_lower, surely_finite, symmetrize

ROUNDING = 1e-13
"""Eigenvalue, relative to the largest, up to which it counts as zero."""
NEGATIVE = 1e-10
"""Size up to which a negative eigenvalue of a correlation matrix counts as a rounding error."""
RESOLUTION = 64 * float(np.finfo(np.float64).eps)
"""Relative resolution of a number that is the result of many roundings."""
BEYOND = 25.0
"""A squared error of more than so many times the square of the resolution is no rounding error."""
_TINY = 1e-280
"""Variance below which numbers have lost digits to underflow."""


def psd_root(a: Float[Array, "*lead n n"]) -> Float[Array, "*lead n n"]:
    """A square root S with S Sᵀ = A of semidefinite matrices.

    The Cholesky factor if it exists, else a root from the eigenvalues of the correlation matrix,
    whose columns span the range of A. NaN where a matrix is not finite or has a negative eigenvalue
    beyond rounding errors: below -`NEGATIVE` in its correlation matrix, and below -`ROUNDING` of
    its largest eigenvalue.
    """
    stack = a if a.ndim == 3 else a[None]
    out = cholesky(stack)
    if not surely_finite(out):
        rest = ~np.isfinite(out).all(axis=(-2, -1)) & np.isfinite(stack).all(axis=(-2, -1))
        if rest.any():
            out[rest] = _roots(stack[rest])
    return out if a.ndim == 3 else out[0]


def range_root(a: Float[Array, "run n n"]) -> Float[Array, "run n n"]:
    """As `psd_root`, without the columns that are rounding errors of a singular A.

    An eigenvalue of the correlation matrix of at most `ROUNDING` counts as zero.
    """
    out = psd_root(a)
    pivots = np.diagonal(out, axis1=-2, axis2=-1) ** 2
    small = (pivots <= ROUNDING * np.diagonal(a, axis1=-2, axis2=-1)).any(axis=-1)
    if small.any():
        out[small] = _roots(a[small], ROUNDING)
    return out


def eigen_root(a: Float[Array, "*lead n n"]) -> tuple[Float[Array, "*lead n n"], Array]:
    """V √Λ of a symmetric matrix V Λ Vᵀ, negative eigenvalues set to zero; and Λ, rising."""
    values, vectors = np.linalg.eigh(symmetrize(a))
    return vectors * np.sqrt(np.clip(values, 0.0, None))[..., None, :], values


def _roots(a: Float[Array, "k n n"], least: float = 0.0) -> Float[Array, "k n n"]:
    """Roots of finite matrices from their eigenvalues above `least`; NaN for an indefinite one."""
    std, known = _scales(a, np.full(a.shape[:-1], _TINY))
    out, values = eigen_root(_correlation(a, std, known))
    out = np.where(known[..., None], 0.0, std[..., None] * out)
    out = np.where(values[:, None] > least, out, 0.0)
    bad = (values[:, 0] < -NEGATIVE) | ~_bounded(a, np.full(a.shape[:-1], _TINY))
    if bad.any():
        whole, values = eigen_root(a[bad])
        definite = values[:, 0] >= -ROUNDING * values[:, -1]
        out[bad] = np.where(definite[:, None, None], whole, np.nan)
    return out


@dataclass(frozen=True, eq=False)
class RangeForm:
    """vᵀ P⁺ v with the pseudo-inverse P⁺, and the degrees of freedom.

    Attributes:
        value: the quadratic form; NaN where P is not finite, or indefinite.
        dof: rank of P.
        known: coordinates that are known exactly.
        white: L⁻¹ v with L Lᵀ = P; NaN where P has not full rank.
    """

    value: Float[Array, " run"]
    dof: Int[Ints, " run"]
    known: Bool[Mask, "run n"]
    white: Float[Array, "run n"]


def range_form(
    cov: Float[Array, "run n n"],
    v: Float[Array, "run n"],
    resolution: Float[Array, "run n"],
) -> RangeForm:
    """vᵀ P⁻¹ v on the range of P, chi-square with rank P degrees of freedom for v ~ N(0, P).

    A component of v outside of the range counts nothing up to 5 times the resolution: it is a
    rounding error. Beyond, P is wrong, and the square of its ratio to the resolution is added: v
    is then as inconsistent as the numbers can tell.

    A matrix with a Cholesky factor, whose pivots are above `ROUNDING` of the variances and above
    the resolution, has full rank; its value is that of the triangular solve.

    Args:
        cov: P.
        v: for instance the error of an estimate.
        resolution: of each coordinate, in its unit: what a rounding error may amount to.
    """
    n = v.shape[-1]
    lower = cholesky(cov)
    white = solve_lower(lower, v[..., None])[..., 0]
    value = np.vecdot(white, white)
    full = full_rank(lower, cov, resolution)
    dof, known = np.full(len(v), n), np.zeros(v.shape, bool)
    if np.count_nonzero(full) < full.size:
        few = ~full.all(axis=-1)
        value[few] = np.nan
        few &= np.isfinite(cov).all(axis=(-2, -1)) & np.isfinite(v).all(axis=-1)
        floor = np.maximum(resolution[few] ** 2, _TINY)
        value[few], dof[few], known[few] = _on_range(cov[few], v[few], floor)
        white = np.where(full.all(axis=-1)[:, None], white, np.nan)
    return RangeForm(value, dof, known, white)


def full_rank(
    factor: Float[Array, "*any n n"],
    cov: Float[Array, "*any n n"],
    resolution: Float[Array, "*any n"],
) -> Bool[Mask, "*any n"]:
    """Which pivots of a triangular factor of P say that P has full rank; see `range_form`."""
    pivots, variance = (a.diagonal(0, -2, -1) for a in (factor, cov))
    return pivots * pivots > np.maximum(ROUNDING * variance, resolution * resolution)


def surely_full_rank(factor: Float[Array, "n n"], cov: Float[Array, "n n"], largest: float) -> bool:
    """Whether a triangular factor of one P shows full rank, by a test that is cheap and too strict.

    Args:
        factor: with its pivots.
        cov: P.
        largest: a bound of the squared size of every coordinate; see `full_rank`.
    """
    pivot, variance = min(factor.diagonal().tolist()), max(cov.diagonal().tolist())
    return pivot * pivot > max(ROUNDING * variance, RESOLUTION * RESOLUTION * largest)


def _on_range(cov: Array, v: Array, floor: Array) -> tuple[Array, Ints, Mask]:
    """Value, rank and known coordinates by eigenvalues; `floor` is the squared resolution."""
    value, dof, known = _spectral(cov, v, floor)
    bad = np.isnan(value)
    if bad.any():
        # The variance of a difference of large numbers is known up to their rounding errors only.
        values = np.linalg.eigvalsh(symmetrize(cov[bad]))
        bad[bad] = values[:, 0] >= -ROUNDING * values[:, -1]
    if bad.any():
        largest = np.diagonal(cov[bad], axis1=-2, axis2=-1).max(axis=-1, keepdims=True)
        rounding = np.maximum(floor[bad], ROUNDING * largest)
        value[bad], dof[bad], known[bad] = _spectral(cov[bad], v[bad], rounding)
    return value, dof, known


def _spectral(cov: Array, v: Array, floor: Array) -> tuple[Array, Ints, Mask]:
    std, known = _scales(cov, floor)
    values, vectors = np.linalg.eigh(_correlation(cov, std, known))
    # What rounding errors of the coordinates amount to along each eigenvector.
    unsure = (vectors**2 * np.where(known, 0.0, floor / std**2)[..., None]).sum(axis=-2)
    least = np.maximum(np.maximum(ROUNDING, unsure), -values)
    along = (np.where(known, 0.0, v / std)[:, None] @ vectors)[:, 0] ** 2
    ranged = values > least
    inside = along / np.where(ranged, values, 1.0)
    outside = np.where(along > BEYOND * least, along / least, 0.0)
    value = np.where(ranged, inside, outside).sum(axis=-1)
    wrong = known & (v**2 > BEYOND * floor)
    value = value + np.where(wrong, v**2 / floor, 0.0).sum(axis=-1)
    indefinite = (values[:, 0] < -NEGATIVE) | ~_bounded(cov, floor)
    dof = np.count_nonzero(ranged, axis=-1) - np.count_nonzero(known, axis=-1)
    return np.where(indefinite, np.nan, value), dof, known


def _scales(cov: Array, floor: Array) -> tuple[Array, Mask]:
    """Standard deviations, 1 for what is known exactly: a variance of at most `floor`."""
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    known = variance <= floor
    return np.sqrt(np.where(known, 1.0, variance)), known


def _correlation(cov: Array, std: Array, known: Mask) -> Array:
    """The correlation matrix, with the rows of the identity for what is known exactly."""
    either = known[:, :, None] | known[:, None, :]
    scaled = symmetrize(cov) / (std[:, :, None] * std[:, None, :])
    return np.where(either, identity(cov.shape[-1]), scaled)


def _bounded(cov: Array, floor: Array) -> Mask:
    """Whether P is symmetric, and Pᵢⱼ² <= Pᵢᵢ Pⱼⱼ, up to rounding errors `(run,)`."""
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    most = 2.0 * np.sqrt(np.maximum(variance, floor))
    bound = most[:, :, None] * most[:, None, :]
    good = (np.abs(cov) <= bound) & (np.abs(cov - cov.mT) <= 1e-9 * bound)
    return np.asarray(good.all(axis=(-2, -1)) & (variance >= -floor).all(axis=-1))
