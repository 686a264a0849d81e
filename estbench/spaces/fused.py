"""Small covariances in one compiled loop over the runs: the extra `fast`.

numba compiles it. numpy takes a call for each product, and holds the interpreter's lock between
them; from n = 12 on it is as fast. `estimators.linear`, `estimators.points` and
`estimators.sigma_points` are the references: the same equations, equal to 1e-12. Their path is
taken in the runs for which a loop would need a branch: where readings did not arrive, or S has no
factor (`estimators.update.looped`).
"""

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from estbench.shapes import Array, Float

Dims = tuple[int, ...]
"""Count of dimensions of each array."""
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


class Loops(NamedTuple):
    """The loops."""

    predict: Callable[..., None]
    update: Callable[..., None]
    update_points: Callable[..., None]
    draw: Callable[..., None]
    moments: Callable[..., None]


@lru_cache(maxsize=1)
def compiled() -> Loops | None:
    """The loops, compiled once on a machine; None without numba."""
    if find_spec("numba") is None:
        return None
    numba = import_module("numba")  # slow

    def compile_for(loop: Callable[..., None], given: Dims, found: Dims) -> Callable[..., None]:
        number, array = numba.types.float64, numba.types.Array
        types = [array(number, k, "C", readonly=True) for k in given]
        types += [array(number, k, "C") for k in found]
        signature = numba.types.void(*types)
        return numba.njit(signature, cache=True, nogil=True, error_model="numpy")(loop)

    numba.extending.register_jitable(_condition)  # two of the loops call it
    updated = (2, 3, 3, 3, 3, 2, 1)
    return Loops(
        compile_for(_predict, (3, 3, 2), (3,)),
        compile_for(_update, (3, 3, 2, 2), updated),
        compile_for(_update_points, (3, 3, 1, 3, 2, 2), updated),
        compile_for(_draw, (2, 3, 2), (3, 3)),
        compile_for(_moments, (3, 1, 1), (2, 3, 3)),
    )


def _predict(F: Any, P: Any, Q: Any, cov: Any) -> None:
    run, n = F.shape[:2]
    row = np.empty(n)
    for r in range(run):
        for i in range(n):
            for j in range(n):
                row[j] = 0.0
                for k in range(n):
                    row[j] += F[r, i, k] * P[r, k, j]
            for j in range(i + 1):
                s = 0.5 * (Q[i, j] + Q[j, i])
                for k in range(n):
                    s += row[k] * F[r, j, k]
                cov[r, i, j] = cov[r, j, i] = s


def _update(P: Any, H: Any, R: Any, nu: Any, delta: Any, cov: Any, S: Any, lower: Any, W: Any,
            white: Any, nis: Any) -> None:  # fmt: skip
    """Every product as loops over its indices, which the compiler unrolls."""
    run, m, n = H.shape
    PHt, K, KR = np.empty((n, m)), np.empty((n, m)), np.empty((n, m))
    A, AP = np.empty((n, n)), np.empty((n, n))
    for r in range(run):
        for i in range(n):
            for j in range(m):
                PHt[i, j] = 0.0
                for k in range(n):
                    PHt[i, j] += P[r, i, k] * H[r, j, k]
        for i in range(m):  # S = H P Hᵀ + R
            for j in range(i + 1):
                s = R[i, j]
                for k in range(n):
                    s += H[r, i, k] * PHt[k, j]
                S[r, i, j] = S[r, j, i] = s
        _condition(r, PHt, nu, S, lower, W, white, nis, delta, K)
        for i in range(n):  # A = I - K H, A P, K R
            for j in range(n):
                A[i, j] = 1.0 if i == j else 0.0
                for k in range(m):
                    A[i, j] -= K[i, k] * H[r, k, j]
            for j in range(m):
                KR[i, j] = 0.0
                for k in range(m):
                    KR[i, j] += K[i, k] * R[k, j]
        for i in range(n):
            for j in range(n):
                AP[i, j] = 0.0
                for k in range(n):
                    AP[i, j] += A[i, k] * P[r, k, j]
        for i in range(n):  # A P Aᵀ + K R Kᵀ
            for j in range(i + 1):
                s = 0.0
                for k in range(n):
                    s += AP[i, k] * A[j, k]
                for k in range(m):
                    s += KR[i, k] * K[j, k]
                cov[r, i, j] = cov[r, j, i] = s


def _update_points(d: Any, z: Any, w: Any, zz: Any, R: Any, nu: Any, delta: Any, cov: Any, S: Any,
                   lower: Any, W: Any, white: Any, nis: Any) -> None:  # fmt: skip
    run, points, n = d.shape
    m = z.shape[2]
    cross, K, KR, left = np.empty((n, m)), np.empty((n, m)), np.empty((n, m)), np.empty((points, n))
    for r in range(run):
        for i in range(m):
            for j in range(i + 1):
                S[r, i, j] = S[r, j, i] = zz[r, i, j] + 0.5 * (R[i, j] + R[j, i])
        for i in range(n):
            for j in range(m):
                s = 0.0
                for p in range(points):
                    s += w[p] * d[r, p, i] * z[r, p, j]
                cross[i, j] = s
        _condition(r, cross, nu, S, lower, W, white, nis, delta, K)
        for i in range(n):  # K R, d - K z
            for j in range(m):
                KR[i, j] = 0.0
                for k in range(m):
                    KR[i, j] += K[i, k] * R[k, j]
            for p in range(points):
                s = d[r, p, i]
                for k in range(m):
                    s -= K[i, k] * z[r, p, k]
                left[p, i] = s
        for i in range(n):  # Σ w (d - K z) (d - K z)ᵀ + K R Kᵀ
            for j in range(i + 1):
                s = 0.0
                for p in range(points):
                    s += w[p] * left[p, i] * left[p, j]
                for k in range(m):
                    s += KR[i, k] * K[j, k]
                cov[r, i, j] = cov[r, j, i] = s


def _condition(r: int, cross: Any, nu: Any, S: Any, lower: Any, W: Any, white: Any, nis: Any,
               delta: Any, K: Any) -> None:  # fmt: skip
    """S = L Lᵀ, W = L⁻¹ Pxyᵀ, L⁻¹ ν, NIS, K = Wᵀ L⁻¹ and K ν of run r, from its Pxy."""
    n, m = cross.shape
    nis[r] = 0.0
    for i in range(m):
        for j in range(i + 1):
            s = S[r, i, j]
            for k in range(j):
                s -= lower[r, i, k] * lower[r, j, k]
            lower[r, j, i] = 0.0
            lower[r, i, j] = np.sqrt(s) if i == j else s / lower[r, j, j]
        for c in range(n + 1):
            s = cross[c, i] if c < n else nu[r, i]
            for k in range(i):
                s -= lower[r, i, k] * (W[r, k, c] if c < n else white[r, k])
            s /= lower[r, i, i]
            if c < n:
                W[r, i, c] = s
            else:
                white[r, i] = s
        nis[r] += white[r, i] ** 2
    for c in range(n):
        delta[r, c] = 0.0
        for i in range(m - 1, -1, -1):
            delta[r, c] += W[r, i, c] * white[r, i]
            s = W[r, i, c]
            for k in range(i + 1, m):
                s -= lower[r, k, i] * K[c, k]
            K[c, i] = s / lower[r, i, i]


def _draw(mean: Any, P: Any, unit: Any, points: Any, spread: Any) -> None:
    run, n = P.shape[:2]
    lower = np.zeros((n, n))
    for r in range(run):
        for i in range(n):
            for j in range(i + 1):
                s = P[r, i, j]
                for k in range(j):
                    s -= lower[i, k] * lower[j, k]
                lower[i, j] = np.sqrt(s) if i == j else s / lower[j, j]
        for p in range(len(unit)):
            for i in range(n):
                s = 0.0
                for k in range(i + 1):
                    s += lower[i, k] * unit[p, k]
                spread[r, p, i] = s
                points[r, p, i] = mean[r, i] + s


def _moments(values: Any, mean_weights: Any, cov_weights: Any, mean: Any, residual: Any,
             cov: Any) -> None:  # fmt: skip
    run, points, n = values.shape
    for r in range(run):
        for i in range(n):
            s = values[r, 0, i]  # exact for a constant; the weights' sum is 1
            for p in range(1, points):
                s += mean_weights[p] * (values[r, p, i] - values[r, 0, i])
            mean[r, i] = s
            for p in range(points):
                residual[r, p, i] = values[r, p, i] - s
            for j in range(i + 1):
                s = 0.0
                for p in range(points):
                    s += cov_weights[p] * residual[r, p, i] * residual[r, p, j]
                cov[r, i, j] = cov[r, j, i] = s
