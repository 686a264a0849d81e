"""Expectation-maximization for Q and R of a linear-Gaussian model.

An independent check of the likelihood search: each iteration raises the same likelihood, without a
derivative, by the smoother (Shumway & Stoffer 1982; Särkkä & Svensson 2023, sec. 16.3.2).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estbench.errors import StudyError
from estbench.estimators.kf import KF
from estbench.following import follow
from estbench.models.linear import LinearModel
from estbench.shapes import Array, Float
from estbench.smoothers.rts import rts
from estbench.spaces.linalg import cholesky, solve_lower, solve_lower_transposed, symmetrize

Form = Literal["full", "diagonal", "factor", "fixed"]
"""Of Q or R: any matrix, a diagonal one, a factor on the matrix of the start, or that matrix."""
FORMS = ("full", "diagonal", "factor", "fixed")


@dataclass(frozen=True, eq=False)
class Maximized:
    """What the iterations gave.

    Attributes:
        model: with Q and R.
        iterations: how many.
        change: of ln Q and ln R in the last one, the largest of their diagonals.
    """

    model: LinearModel
    iterations: int
    change: float


def maximize(
    model: LinearModel,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    y: ArrayLike,
    *,
    u: ArrayLike | None = None,
    Q: Form = "full",
    R: Form = "full",
    iterations: int = 1000,
    tolerance: float = 1e-9,
) -> Maximized:
    """Iterate from the model's Q and R to a maximum of the likelihood of y.

    Args:
        model: A, B, C, D are kept; Q and R `(n, n)`, `(m, m)` are the start.
        mean: x̂₀.
        cov: P₀.
        y: measurements `(K, run, m)` after each of K steps, all of them there.
        u: controls `(K, run, nu)`; default 0.
        Q: form of Q.
        R: form of R.
        iterations: at most.
        tolerance: least change of ln Q and ln R with which to go on.

    Raises:
        StudyError: a form is unknown, or a measurement is missing.
    """
    for name, form in (("Q", Q), ("R", R)):
        if form not in FORMS:
            raise StudyError(f"{name} is {form!r}; use one of {', '.join(FORMS)}")
    readings = np.asarray(y, dtype=np.float64)
    if np.isnan(readings).any():
        raise StudyError("y has missing measurements (NaN), which EM cannot use; tune instead")
    change, done = np.inf, 0
    while done < iterations and change > tolerance:
        now = step(model, mean, cov, readings, u=u, Q=Q, R=R)
        change = max(_change(model.Q, now.Q), _change(model.R, now.R))
        model, done = now, done + 1
    return Maximized(model, done, change)


def step(
    model: LinearModel,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    y: Float[Array, "step run m"],
    *,
    u: ArrayLike | None = None,
    Q: Form = "full",
    R: Form = "full",
) -> LinearModel:
    """One iteration: the second moments of w and v given all measurements become Q and R.

        Q = Σ E[(x₊ - A x - B u)(x₊ - A x - B u)ᵀ | y]/N,  R = Σ E[(y - C x - D u)(...)ᵀ | y]/N

    with the covariance of neighbours Cov(x₊, x | y) = P₊ˢ Gᵀ, G the smoother's gain.
    """
    history = follow(KF(model), mean, cov, y, u=u)
    controls = history.controls
    smoothed = rts(model, history.beliefs, controls, history.times)
    A, C = model.A, model.C
    process, measured = np.zeros_like(model.Q), np.zeros_like(model.R)
    for k, reading in enumerate(y):
        now, later, held = smoothed[k], smoothed[k + 1], controls[k]
        P = history.beliefs[k].cov
        predicted = symmetrize(A @ P @ A.mT + model.Q)
        lower = cholesky(predicted)
        gain = np.swapaxes(solve_lower_transposed(lower, solve_lower(lower, A @ P)), -1, -2)
        cross = later.cov @ gain.mT
        w = later.mean - model.transition(now.mean, held)
        spread = later.cov - cross @ A.mT - A @ cross.mT + A @ now.cov @ A.mT
        process += (w[:, :, None] * w[:, None] + spread).mean(axis=0)
        v = reading - model.measurement(later.mean, held)
        measured += (v[:, :, None] * v[:, None] + C @ later.cov @ C.mT).mean(axis=0)
    count = len(y)
    return replace(
        model,
        Q=_formed(symmetrize(process / count), model.Q, Q),
        R=_formed(symmetrize(measured / count), model.R, R),
    )


def _formed(moment: Array, before: Array, form: Form) -> Array:
    """The maximizer of the expected likelihood in a form."""
    if form == "full":
        return moment
    if form == "diagonal":
        return np.diag(np.diag(moment))
    if form == "fixed":
        return before
    values, vectors = np.linalg.eigh(before)
    firm = values > 1e-12 * values.max()
    inside = vectors[:, firm].T @ moment @ vectors[:, firm]
    return before * float(np.mean(np.diag(inside) / values[firm]))


def _change(before: Array, now: Array) -> float:
    """The largest change of the logarithm of a variance."""
    a, b = np.diag(before), np.diag(now)
    positive = (a > 0) & (b > 0)
    return float(np.abs(np.log(b[positive] / a[positive])).max(initial=0.0))
