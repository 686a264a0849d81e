"""Triangular factors of covariances, by QR and by rank-one updates, and beliefs made of them."""

from dataclasses import dataclass

import numpy as np

from estbench.estimators.beliefs import Fault, Gaussian, check_prior
from estbench.estimators.protocol import Gain, Innovation
from estbench.estimators.update import mark_failed
from estbench.shapes import Array, Bool, Faults, Float, Mask, UInt
from estbench.spaces.linalg import cholesky, pad_absent, solve_lower, surely_finite
from estbench.spaces.manifold import Manifold
from estbench.spaces.semidefinite import ROUNDING, psd_root


@dataclass(frozen=True, eq=False)
class FactorBelief:
    """A Gaussian belief with a lower triangular factor L of its covariance, P = L Lᵀ.

    A failed run has NaN in mean and factor.

    Attributes:
        mean: x̂.
        factor: L.
        fault: `Fault` of each run.
    """

    mean: Float[Array, "run nx"]
    factor: Float[Array, "run n n"]
    fault: UInt[Faults, " run"]

    @property
    def cov(self) -> Float[Array, "run n n"]:
        """The covariance P = L Lᵀ."""
        return self.factor @ self.factor.mT


class FactorEstimator:
    """Base of the square-root filters: init, mean and cov."""

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> FactorBelief:
        """Start from N(mean, cov); cov may be semidefinite."""
        check_prior(getattr(getattr(self, "model", None), "space", None), mean, cov)
        factor = triangular(psd_root(cov))
        return factor_belief(mean, factor, np.zeros(len(mean), np.uint8), lost(factor, cov))

    def mean(self, belief: FactorBelief) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return belief.mean

    def cov(self, belief: FactorBelief) -> Float[Array, "run n n"]:
        """The covariance P = L Lᵀ."""
        return belief.cov


def factor_belief(
    mean: Float[Array, "run nx"],
    factor: Float[Array, "run n n"],
    fault: UInt[Faults, " run"],
    new: UInt[Faults, " run"] | None = None,
) -> FactorBelief:
    """A belief in which every run that is not finite, or has a `new` fault, is marked as failed."""
    checked = mark_failed(Gaussian(mean, factor, fault), new)
    return FactorBelief(checked.mean, checked.cov, checked.fault)


def factor_settle(
    space: Manifold,
    prior: FactorBelief,
    delta: Float[Array, "run n"],
    factor: Float[Array, "run n k"],
    fault: UInt[Faults, " run"] | None = None,
) -> FactorBelief:
    """The posterior x̂⁻ ⊞ δ, its factor J L in the tangent there made triangular."""
    if not space.flat:
        factor = triangular(space.reset_jacobian(delta) @ factor)
    return factor_belief(space.plus(prior.mean, delta), factor, prior.fault, fault)


def lost(
    factor: Float[Array, "run n n"],
    ingredients: Float[Array, "run ..."],
    code: Fault = Fault.COVARIANCE,
) -> UInt[Faults, " run"]:
    """The fault `code` where a factor is not finite although its `ingredients` are."""
    if surely_finite(factor):
        return np.zeros(len(factor), np.uint8)
    failed = ~np.isfinite(factor).all(axis=(-2, -1))
    failed = failed & np.isfinite(ingredients).all(axis=(-2, -1))
    return np.where(failed, code, Fault.NONE).astype(np.uint8)


def triangular(root: Float[Array, "run n k"]) -> Float[Array, "run n n"]:
    """Lower triangular L with L Lᵀ = A Aᵀ, by QR of Aᵀ; A has k >= n columns.

    The diagonal is not negative: L is the Cholesky factor if A Aᵀ is positive definite.
    """
    upper = np.linalg.qr(root.mT, mode="r")
    sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return (upper * sign[..., None]).mT


def weighted_factor(
    weights: Float[Array, " point"],
    residuals: Float[Array, "run point n"],
    noise: Float[Array, "run n k"],
) -> Float[Array, "run n n"]:
    """The triangular factor of Σ wᵢ rᵢ rᵢᵀ + N Nᵀ, by QR of the weighted residuals and N.

    Args:
        weights: w; of a scaled rule, so that only the first may be negative.
        residuals: r; the first is that of the centre, a downdate where its weight is negative.
        noise: N.
    """
    down = int(weights[0] < 0)
    columns = (np.sqrt(weights[down:, None]) * residuals[:, down:]).mT
    factor = triangular(np.concatenate([columns, noise], axis=-1))
    return cholesky_update(factor, residuals[:, 0], float(weights[0])) if down else factor


def noise_root(
    R: Float[Array, "... m m"], mask: Bool[Mask, "run m"] | None, runs: int
) -> Float[Array, "run m m"]:
    """The Cholesky factor of R; rows that did not arrive are those of the identity."""
    if mask is not None:
        R = pad_absent(R, mask)
    lower = cholesky(R if R.ndim == 3 else R[None])
    return np.broadcast_to(lower, (runs, *lower.shape[-2:]))


def factor_innovation(
    residual: Float[Array, "run m"],
    root: Float[Array, "run m m"],
    scaled: Float[Array, "run n m"],
    mask: Bool[Mask, "run m"] | None = None,
) -> Innovation:
    """The innovation from ν, a factor of S and K S^½; ν is zero where nothing arrived."""
    white = solve_lower(root, residual[..., None])[..., 0]
    S = root @ root.mT
    dof = np.full(len(root), root.shape[-1])
    if mask is not None:
        # QR leaves rounding errors in the rows of the identity.
        white = np.where(mask, white, 0.0)
        S, root = pad_absent(S, mask), pad_absent(root, mask)
        dof = mask.sum(axis=-1)
    nis = np.einsum("ij,ij->i", white, white)
    return Innovation(residual, S, white, nis, dof, root, gain=Gain(scaled, root))


def cholesky_update(
    factor: Float[Array, "run n n"], vector: Float[Array, "run n"], weight: float = 1.0
) -> Float[Array, "run n n"]:
    """The Cholesky factor of L Lᵀ + w v vᵀ; NaN where that is not positive definite.

    Column by column: for w > 0 a plane rotation moves the component of v into the diagonal (LINPACK
    `dchud`), for w < 0 a hyperbolic rotation in its mixed, stable form (Golub & Van Loan, Matrix
    Computations, 4th ed., sec. 6.5). Where L has a zero pivot and v no component, up to rounding
    errors, a downdate leaves the column alone. Cost: n steps of O(n), vectorized over the runs.

    Args:
        factor: L, lower triangular.
        vector: v.
        weight: w, of either sign.
    """
    out, x = factor.copy(), np.sqrt(abs(weight)) * vector
    least = ROUNDING * np.vecdot(factor, factor)
    for k in range(factor.shape[-1]):
        column, pivot, head = out[:, k:, k].copy(), out[:, k, k, None], x[:, k, None]
        if weight >= 0:
            r = np.hypot(pivot, head)
            r, pivot = np.where(r > 0, r, 1.0), np.where(r > 0, pivot, 1.0)
            cosine, sine = pivot / r, head / r
            out[:, k:, k] = cosine * column + sine * x[:, k:]
            x[:, k:] = cosine * x[:, k:] - sine * column
        else:
            nothing = np.maximum(pivot**2, head**2) <= least[:, k, None]
            safe = np.where(pivot > 0, pivot, np.nan)
            sine = np.where(nothing, 0.0, head / safe)
            square = (1.0 - sine) * (1.0 + sine)
            cosine = np.sqrt(np.where(square > 0, square, np.nan))
            out[:, k:, k] = (column - sine * x[:, k:]) / cosine
            x[:, k:] = cosine * x[:, k:] - sine * out[:, k:, k]
    return out
