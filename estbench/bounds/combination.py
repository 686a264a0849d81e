"""The best linear combinations of variations, shared by all runs or for each run.

The first n span what V W⁻¹ Vᵀ needs. A reading that is still on its way needs more: it will be of
another state than the present one. So the combinations that change what it will show are kept as
well, those that change it most, up to `MOST` times the dimension of the state.
"""

from collections.abc import Sequence

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.linalg import solve_lower, solve_lower_transposed, solve_one_lower

MOST = 4
"""Combinations kept for readings on their way, in dimensions of the state: with more a step would
cost more, with fewer the bound would be lower."""
NOTHING = 1e-9
"""A change of a reading, in units of its noise, that is of rounding."""


def best(
    W: Float[Array, "k k"], V: Float[Array, "n k"], later: Sequence[Float[Array, "_ _"]] = ()
) -> tuple[Float[Array, "k _"], Float[Array, "n _"]]:
    """The combinations with W = I and V = T, and T with T Tᵀ = V W⁻¹ Vᵀ.

    Args:
        W: weight of the variations.
        V: mean change of the state.
        later: mean changes of readings on their way; the last columns are 0 where they lack.
    """
    scale, n = 1.0 / np.sqrt(np.diag(W)), len(V)
    L = np.asarray(np.linalg.cholesky(W * np.outer(scale, scale)), np.float64)
    basis, T = np.linalg.qr(solve_one_lower(L, (V * scale).T), "complete" if later else "reduced")
    if later:
        rest = solve_one_lower(L, (_padded(later, len(W)) * scale).T)
        basis = _with_more(basis, rest, n)
    factor = np.zeros((n, basis.shape[1]))
    factor[:, :n] = T[:n].T
    back = np.asarray(np.linalg.solve(L.T, basis), np.float64)  # upper triangular: no pivots
    return scale[:, None] * back, factor


def best_of_each(
    W: Float[Array, "run k k"],
    V: Float[Array, "run n k"],
    later: Sequence[Float[Array, "run _ _"]] = (),
) -> tuple[Float[Array, "run k _"], Float[Array, "run n _"]]:
    """As `best`, for each run; all keep equally many combinations."""
    L = np.asarray(np.linalg.cholesky(W), np.float64)
    n = V.shape[-2]
    basis, T = np.linalg.qr(solve_lower(L, V.mT), "complete" if later else "reduced")
    if later:
        rest = solve_lower(L, _padded(later, W.shape[-1]).mT)
        basis = _with_more(basis, rest, n)
    factor = np.zeros((*V.shape[:-1], basis.shape[-1]))
    factor[..., :n] = T[..., :n, :].mT
    return solve_lower_transposed(L, basis), factor


def _with_more(
    basis: Float[Array, "*any k k"], rest: Float[Array, "*any k _"], n: int
) -> Float[Array, "*any k _"]:
    """The first n columns of an orthonormal basis, and those in which readings change most.

    Args:
        basis: its first n columns are kept.
        rest: changes of the readings.
        n: dimension of the state.
    """
    others = basis[..., n:]
    directions, size, _ = np.linalg.svd(others.mT @ rest, full_matrices=False)
    count = min(int((size > NOTHING).any(axis=tuple(range(size.ndim - 1))).sum()), MOST * n)
    return np.concatenate([basis[..., :n], others @ directions[..., :count]], axis=-1)


def _padded(parts: Sequence[Float[Array, "... _ _"]], width: int) -> Float[Array, "... _ k"]:
    """One below the other, with columns of zeros up to a width."""
    out = []
    for part in parts:
        missing = np.zeros((*part.shape[:-1], width - part.shape[-1]))
        out.append(np.concatenate([part, missing], axis=-1))
    return np.concatenate(out, axis=-2)
