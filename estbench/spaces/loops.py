"""Loops over the runs, which numba compiles; `fused` says what they compute, and takes them.

They are plain functions of arrays, so that the interpreter can run them too.
"""

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

Dims = tuple[int, ...]
"""Count of dimensions of each array."""


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
                s = 0.0
                for k in range(n):
                    s += F[r, i, k] * P[r, k, j]
                row[j] = s
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
                s = 0.0
                for k in range(n):
                    s += P[r, i, k] * H[r, j, k]
                PHt[i, j] = s
        for i in range(m):  # S = H P Hᵀ + R
            for j in range(i + 1):
                s = R[i, j]
                for k in range(n):
                    s += H[r, i, k] * PHt[k, j]
                S[r, i, j] = S[r, j, i] = s
        _condition(r, PHt, nu, S, lower, W, white, nis, delta, K)
        for i in range(n):  # A = I - K H, A P, K R
            for j in range(n):
                s = 1.0 if i == j else 0.0
                for k in range(m):
                    s -= K[i, k] * H[r, k, j]
                A[i, j] = s
            for j in range(m):
                s = 0.0
                for k in range(m):
                    s += K[i, k] * R[k, j]
                KR[i, j] = s
        for i in range(n):
            for j in range(n):
                s = 0.0
                for k in range(n):
                    s += A[i, k] * P[r, k, j]
                AP[i, j] = s
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
                s = 0.0
                for k in range(m):
                    s += K[i, k] * R[k, j]
                KR[i, j] = s
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
