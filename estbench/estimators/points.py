"""The update of the sigma-point filters, from points and their images."""

from typing import Any

from estbench.estimators.sigma_points import SigmaPoints
from estbench.estimators.update import Update, correct, looped
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces import fused
from estbench.spaces.linalg import symmetrize


def points_update(
    rule: SigmaPoints,
    residual: Float[Array, "run m"],
    spread: Float[Array, "run point n"],
    images: Float[Array, "run point m"],
    cov: Float[Array, "run m m"],
    R: Float[Array, "... m m"],
    mask: Bool[Mask, "run m"] | None = None,
) -> Update:
    """Condition on ν with Pxy and S from the points (source 003, eq. 11).

    P⁺ is computed as Σ wᵢ rᵢ rᵢᵀ + K R Kᵀ with rᵢ = (xᵢ ⊖ x̂⁻) - K (h(xᵢ) ⊖ ŷ), the points' form of
    Joseph's: it keeps P semidefinite, and its digits where P⁺ is much smaller than P⁻.

    Args:
        rule: the weights.
        residual: ν = y ⊖ ŷ.
        spread: xᵢ ⊖ x̂⁻.
        images: h(xᵢ) ⊖ ŷ.
        cov: their covariance, S without R.
        R: covariance of the reading's noise; one, or one per run.
        mask: True where a component arrived; None if all did.
    """

    def numpy(rows: Any, mask: Mask | None) -> Update:  # a shape here would cost 15 µs a call
        d, z, noise = spread[rows], images[rows], R if R.ndim == 2 else R[rows]
        c = correct(residual[rows], symmetrize(cov[rows] + noise), rule.cross(d, z), mask)
        left = d - z @ c.gain.mT
        after = symmetrize(rule.cross(left, left) + c.gain @ noise @ c.gain.mT)
        return Update(c.delta, after, c.innovation, c.fault)

    loop = fused.updated_points(spread, images, rule.cov_weights, cov, R, residual)
    return looped(loop, residual, mask, numpy)
