"""The error of a filter with given gains, split by its sources (Gelb 1974, ch. 7 and 8).

The error e = x ⊖ x̂ of a filter whose model is F, H and whose gain is K, and the truth's errors:

    prediction:  e⁻ = F e⁺ + G w + d          update:  e⁺ = (I - K H) e⁻ - K (C b + v + s)

w and v are white, b are errors of sensors, d and s what the filter's model leaves out. K need not
be the optimal gain of the truth. All is linear, and the sources are independent, so that each is
followed by itself and the covariances add up.

A source that is constant in each run (an initial error, a bias, a wrong parameter) is a column of
`fixed`: the response of e to one standard deviation of it. One that is driven by white noise has a
covariance, together with the state b of a sensor's error that drifts.
"""

from dataclasses import dataclass

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.linalg import symmetrize


@dataclass(frozen=True, eq=False)
class Spread:
    """The error of a filter by its sources, at one time.

    Attributes:
        fixed: response of e to a unit of each constant.
        moving: covariance of e and b for each source of white noise; N = n + w.
    """

    fixed: Float[Array, "run n c"]
    moving: Float[Array, "run s N N"]


@dataclass(frozen=True, eq=False)
class Interval:
    """One prediction.

    Attributes:
        F: of the filter's model.
        Q: of the truth, by sources.
        d: what the constants add; None for nothing.
        keep: what is left of b.
        fresh: variance of what is new in b.
    """

    F: Float[Array, "run n n"]
    Q: Float[Array, "... s n n"]
    d: Float[Array, "run n c"] | None
    keep: Float[Array, "s w"]
    fresh: Float[Array, "s w"]


@dataclass(frozen=True, eq=False)
class Reading:
    """One joint measurement.

    Attributes:
        H: of the filter's model.
        R: of the truth, by sources.
        s: what the constants add to the reading.
        C: what b adds to it.
    """

    H: Float[Array, "run m n"]
    R: Float[Array, "s m m"]
    s: Float[Array, "run m c"]
    C: Float[Array, "s m w"]


def predicted(now: Spread, over: Interval) -> Spread:
    """The spread after a prediction: F e + d, and A Σ Aᵀ + Q with A = diag(F, keep)."""
    fixed = over.F @ now.fixed
    if over.d is not None:
        fixed = fixed + over.d
    n, w = over.F.shape[-1], over.keep.shape[-1]
    F = over.F[:, None]
    if not w:
        return Spread(fixed, symmetrize(F @ now.moving @ F.mT + over.Q))
    moving = now.moving.copy()
    moving[..., :n, :] = F @ moving[..., :n, :]
    moving[..., :, :n] = moving[..., :, :n] @ F.mT
    moving[..., n:, :] *= over.keep[:, :, None]
    moving[..., :, n:] *= over.keep[:, None, :]
    moving[..., :n, :n] += over.Q
    moving[..., n:, n:] += over.fresh[:, :, None] * np.eye(w)
    return Spread(fixed, symmetrize(moving))


def updated(prior: Spread, K: Float[Array, "run n m"], seen: Reading) -> Spread:
    """The spread after an update with the gain K, which is zero for what did not arrive."""
    n, w = K.shape[-2], seen.C.shape[-1]
    A = np.eye(n) - K @ seen.H
    fixed = A @ prior.fixed - K @ seen.s
    A, K = A[:, None], K[:, None]
    noise = K @ seen.R @ K.mT
    if not w:
        return Spread(fixed, symmetrize(A @ prior.moving @ A.mT + noise))
    error, KC = prior.moving[..., :n, :], K @ seen.C
    top = A @ error - KC @ prior.moving[..., n:, :]
    moving = prior.moving.copy()
    moving[..., :n, :n] = top[..., :n] @ A.mT - top[..., n:] @ KC.mT + noise
    moving[..., :n, n:] = top[..., n:]
    moving[..., n:, :n] = top[..., n:].mT
    return Spread(fixed, symmetrize(moving))
