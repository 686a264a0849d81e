"""Small covariances in one compiled loop over the runs (`loops`): the extra `fast`.

numpy takes a call for each product, and holds the interpreter's lock between them; from n = 12 on
it is as fast. `estimators.linear`, `estimators.points` and `estimators.sigma_points` are the
references: the same equations, equal to 1e-12. Their path is taken in the runs for which a loop
would need a branch: where readings did not arrive, or S has no factor (`estimators.update.looped`).
"""

from typing import NamedTuple

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.loops import compiled

LARGEST = 6
"""n and m up to which the loop is taken."""


class Updated(NamedTuple):
    """What an update gives: K ν, P⁺ (Joseph), S and its factor L, W = L⁻¹ H P, L⁻¹ ν, and NIS."""

    delta: Float[Array, "run n"]
    cov: Float[Array, "run n n"]
    S: Float[Array, "run m m"]
    lower: Float[Array, "run m m"]
    W: Float[Array, "run m n"]
    white: Float[Array, "run m"]
    nis: Float[Array, " run"]


def updated(
    P: Float[Array, "run n n"],
    H: Float[Array, "run m n"],
    R: Float[Array, "... m m"],
    residual: Float[Array, "run m"],
) -> Updated | None:
    """An update with one R for all runs; None where numpy has to do it for all.

    K = P Hᵀ S⁻¹, P⁺ = (I - K H) P (I - K H)ᵀ + K R Kᵀ (Bishop, eq. 19-20). NIS is not finite in the
    runs where S has no factor.
    """
    run, m, n = H.shape
    if max(m, n) > LARGEST or R.ndim != 2 or len(P) != run or not (loop := compiled()):
        return None
    out = _empty(run, n, m)
    loop.update(*map(np.ascontiguousarray, (P, H, R, residual)), *out)
    return out


def updated_points(
    spread: Float[Array, "run point n"],
    images: Float[Array, "run point m"],
    weights: Float[Array, " point"],
    cov: Float[Array, "run m m"],
    R: Float[Array, "... m m"],
    residual: Float[Array, "run m"],
) -> Updated | None:
    """An update by points with one R for all runs; None where numpy has to do it for all.

    K = Σ wᵢ dᵢ zᵢᵀ S⁻¹, rᵢ = dᵢ - K zᵢ, P⁺ = Σ wᵢ rᵢ rᵢᵀ + K R Kᵀ. NIS is not finite in the runs
    where S has no factor.

    Args:
        spread: d, the points from their mean.
        images: z, their readings from the predicted one.
        weights: w.
        cov: S - R = Σ wᵢ zᵢ zᵢᵀ.
        R: covariance of the reading's noise.
        residual: ν.
    """
    run, _, n = spread.shape
    m = images.shape[-1]
    if max(m, n) > LARGEST or R.ndim != 2 or not (loop := compiled()):
        return None
    out = _empty(run, n, m)
    given = spread, images, weights, cov, R, residual
    loop.update_points(*map(np.ascontiguousarray, given), *out)
    return out


def drawn(
    mean: Float[Array, "run n"], P: Float[Array, "run n n"], unit: Float[Array, "*run point n"]
) -> tuple[Float[Array, "run point n"], Float[Array, "run point n"]] | None:
    """x̂ + L ξ and L ξ of every unit point ξ, with L Lᵀ = P; None where numpy has to do it for all.

    They have NaN in the runs where P has no Cholesky factor.
    """
    run, n = mean.shape
    if n > LARGEST or unit.ndim != 2 or not (loop := compiled()):
        return None
    points, spread = np.empty((2, run, len(unit), n))
    loop.draw(*map(np.ascontiguousarray, (mean, P, unit)), points, spread)
    return points, spread


def moments(
    values: Float[Array, "run point k"],
    mean_weights: Float[Array, " point"],
    cov_weights: Float[Array, " point"],
) -> tuple[Float[Array, "run k"], Float[Array, "run point k"], Float[Array, "run k k"]] | None:
    """Weighted mean of the values, their residuals and their covariance; None without the loop."""
    run, _, k = values.shape
    if k > LARGEST or not (loop := compiled()):
        return None
    out = np.empty((run, k)), np.empty(values.shape), np.empty((run, k, k))
    loop.moments(*map(np.ascontiguousarray, (values, mean_weights, cov_weights)), *out)
    return out


def _empty(run: int, n: int, m: int) -> Updated:
    shapes = ((n,), (n, n), (m, m), (m, m), (m, n), (m,), ())
    return Updated(*(np.empty((run, *shape)) for shape in shapes))


def predicted(
    F: Float[Array, "run n n"], P: Float[Array, "run n n"], Q: Float[Array, "... n n"]
) -> Float[Array, "run n n"] | None:
    """F P Fᵀ + Q with one Q for all runs (Bishop, eq. 11); None where numpy has to do it."""
    if P.shape[-1] > LARGEST or Q.ndim != 2 or F.shape != P.shape or not (loop := compiled()):
        return None
    out = np.empty(P.shape)
    loop.predict(*map(np.ascontiguousarray, (F, P, Q)), out)
    return out
