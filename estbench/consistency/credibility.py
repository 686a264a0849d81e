"""Noncredibility index and inclination indicator: by how much P is too small or too large.

X. R. Li & Z. Zhao, "Measuring estimator's credibility: noncredibility index", FUSION 2006. The
index compares the NEES of each run with the NEES under the errors' true mean square matrix. Unlike
ANEES it gives optimism and pessimism the same weight.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.linalg import cholesky, identity, solve_lower


@dataclass(frozen=True, eq=False)
class Credibility:
    """Noncredibility index and inclination, dB; 0 is credible.

    Attributes:
        nci: γ = 10/M Σᵢ |log₁₀ ρᵢ| at each step.
        inclination: ν = 10/M Σᵢ log₁₀ ρᵢ: above 0 optimistic (P too small), below 0
            pessimistic.
        expected: γ of a credible estimator with as many runs. It is above 0, as the mean square
            matrix is estimated from these runs.
    """

    nci: Float[Array, " step"]
    inclination: Float[Array, " step"]
    expected: float


def mean_square(error: Float[Array, "run step n"]) -> Float[Array, "step n n"]:
    """Σ = 1/M Σᵢ eᵢ eᵢᵀ over the runs at each step."""
    return np.einsum("rki,rkj->kij", error, error, optimize=True) / len(error)


def log_ratios(
    error: Float[Array, "run step n"],
    nees: Float[Array, "run step"],
    square: Float[Array, "step n n"],
) -> Float[Array, "run step"]:
    """10 log₁₀ ρ, ρ = eᵀP⁻¹e / eᵀΣ⁻¹e of each run and step, dB.

    Args:
        error: x ⊖ x̂.
        nees: eᵀP⁻¹e.
        square: Σ, `mean_square` of all runs. A coordinate without any error counts nothing. Where
            the others' Σ is singular (fewer runs than coordinates) the ratio is NaN.
    """
    exact = np.diagonal(square, axis1=-2, axis2=-1) == 0
    square = square + exact[..., None] * identity(square.shape[-1])
    white = solve_lower(cholesky(square), np.moveaxis(error, 0, -1))  # (step, n, run)
    ideal = np.einsum("kir,kir->rk", white, white)
    with np.errstate(invalid="ignore", divide="ignore"):
        return 10 * np.log10(nees / ideal)


def credibility(
    batches: Callable[[], Iterable[tuple[Float[Array, "run step n"], Float[Array, "run step"]]]],
) -> Credibility:
    """NCI and inclination at each step, with one batch of runs in memory at a time.

    Args:
        batches: each call gives x ⊖ x̂, 0 of a coordinate that is known exactly, and NEES of the
            runs that did not diverge, batch by batch. It is called twice, first for Σ.

    Returns:
        NaN where there are no more runs than coordinates.
    """
    runs, square, n = 0, np.zeros(()), 0
    for error, _ in batches():
        square = square + len(error) * mean_square(error) if len(error) else square
        runs, n = runs + len(error), error.shape[-1]
    if runs <= n:  # Σ has no inverse
        nothing = np.full(square.shape[:1] or 1, np.nan)
        return Credibility(nothing, nothing, np.nan)
    square = square / runs
    size = total = np.zeros(square.shape[:1])
    for error, nees in batches():
        if len(error):
            ratios = log_ratios(error, nees, square)
            size, total = size + np.abs(ratios).sum(axis=0), total + ratios.sum(axis=0)
    inexact = np.diagonal(square, axis1=-2, axis2=-1) > 0
    return Credibility(size / runs, total / runs, expected(round(inexact.sum(-1).mean()), runs))


def expected(n: int, runs: int, repetitions: int = 200, seed: int = 0) -> float:
    """NCI of an estimator whose P is correct, dB, by Monte Carlo; NaN for `runs` <= n.

    Args:
        n: dimension of the error.
        runs: from which Σ is estimated; more than 10,000 are taken as 10,000.
        repetitions: of the simulation; reduced where runs are many.
        seed: of the simulation.
    """
    if runs <= n:
        return float("nan")
    runs = min(runs, 10_000)
    count = max(2, min(repetitions, 100_000 // runs))
    error = np.random.default_rng(seed).standard_normal((runs, count, n))
    return float(np.abs(log_ratios(error, (error**2).sum(-1), mean_square(error))).mean())
