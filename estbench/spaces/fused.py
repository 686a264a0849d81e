"""Prediction and update of small covariances in one compiled loop over the runs: the extra `fast`.

numba compiles it. numpy takes a call for each product, and holds the interpreter's lock between
them; from n = 12 on it is as fast. `estimators.linear` is the reference: the same equations, equal
to 1e-12. Its path is taken for whatever a loop would need a branch for: readings that did not
arrive, an S without a factor.
"""

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.linalg import surely_finite

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
    """An update with one R for all runs; None where numpy has to do it.

    K = P Hᵀ S⁻¹, P⁺ = (I - K H) P (I - K H)ᵀ + K R Kᵀ (Bishop, eq. 19-20).
    """
    run, m, n = H.shape
    if max(m, n) > LARGEST or R.ndim != 2 or len(P) != run or not (loop := compiled()):
        return None
    out = Updated(*(np.empty((run, *s)) for s in ((n,), (n, n), (m, m), (m, m), (m, n), (m,), ())))
    loop.update(*map(np.ascontiguousarray, (P, H, R, residual)), *out)
    return out if surely_finite(out.nis) else None


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
    """The two loops."""

    predict: Callable[..., None]
    update: Callable[..., None]


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

    return Loops(
        compile_for(_predict, (3, 3, 2), (3,)),
        compile_for(_update, (3, 3, 2, 2), (2, 3, 3, 3, 3, 2, 1)),
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
        nis[r] = 0.0
        for i in range(m):  # S = L Lᵀ, W = L⁻¹ H P, L⁻¹ ν
            for j in range(i + 1):
                s = S[r, i, j]
                for k in range(j):
                    s -= lower[r, i, k] * lower[r, j, k]
                lower[r, j, i] = 0.0
                lower[r, i, j] = np.sqrt(s) if i == j else s / lower[r, j, j]
            for c in range(n + 1):
                s = PHt[c, i] if c < n else nu[r, i]
                for k in range(i):
                    s -= lower[r, i, k] * (W[r, k, c] if c < n else white[r, k])
                s /= lower[r, i, i]
                if c < n:
                    W[r, i, c] = s
                else:
                    white[r, i] = s
            nis[r] += white[r, i] ** 2
        for c in range(n):  # K = Wᵀ L⁻¹, K ν = Wᵀ (L⁻¹ ν)
            delta[r, c] = 0.0
            for i in range(m - 1, -1, -1):
                delta[r, c] += W[r, i, c] * white[r, i]
                s = W[r, i, c]
                for k in range(i + 1, m):
                    s -= lower[r, k, i] * K[c, k]
                K[c, i] = s / lower[r, i, i]
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
