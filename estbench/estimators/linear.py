"""What the linear filters share: P⁻, and the update with P⁺ in one of three forms."""

from typing import Any, Literal, TypeVar, cast

import numpy as np

from estbench.estimators.beliefs import Gaussian
from estbench.estimators.protocol import Innovation
from estbench.estimators.update import Correction, Update, apply_correction, correct, looped
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces import fused
from estbench.spaces.linalg import identity, pad_absent, symmetrize
from estbench.spaces.manifold import Manifold

Belief = TypeVar("Belief", bound=Gaussian)
Form = Literal["joseph", "simplified", "symmetric"]
FORMS = ("joseph", "simplified", "symmetric")


def predicted_cov(
    F: Float[Array, "run n n"], P: Float[Array, "run n n"], Q: Float[Array, "... n n"]
) -> Float[Array, "run n n"]:
    """P⁻ = F P⁺ Fᵀ + Q (Bishop, eq. 11), symmetric.

    Args:
        F: transition Jacobian.
        P: posterior covariance P⁺.
        Q: process noise covariance; one, or one per run.
    """
    loop = fused.predicted(F, P, Q)
    return symmetrize(F @ P @ F.mT + Q) if loop is None else loop


def linear_update(
    space: Manifold,
    belief: Belief,
    residual: Float[Array, "run m"],
    H: Float[Array, "run m n"],
    R: Float[Array, "... m m"],
    mask: Bool[Mask, "run m"] | None = None,
    form: Form = "joseph",
) -> tuple[Belief, Innovation]:
    """Condition on ν = H e + v: K = P Hᵀ S⁻¹ (Bishop, eq. 20), x̂⁺ = x̂⁻ ⊞ K ν (eq. 17).

    Args:
        space: the state space.
        belief: the prior.
        residual: ν.
        H: measurement Jacobian.
        R: measurement noise covariance; one, or one per run.
        mask: True where a component arrived; None if all did.
        form: form of the covariance, see `posterior_cov`.
    """

    def numpy(rows: Any, mask: Mask | None) -> Update:  # a shape here would cost 15 µs a call
        P, jacobian, noise = belief.cov[rows], H[rows], R if R.ndim == 2 else R[rows]
        PHt = P @ jacobian.mT
        c = correct(residual[rows], symmetrize(jacobian @ PHt + noise), PHt, mask)
        cov = symmetrize(posterior_cov(form, P, c, jacobian, noise))
        return Update(c.delta, cov, c.innovation, c.fault)

    loop = fused.updated(belief.cov, H, R, residual) if form == "joseph" else None
    found = looped(loop, residual, mask, numpy)
    posterior = apply_correction(space, belief, found.delta, found.cov, found.fault)
    return cast(Belief, posterior), found.innovation


def posterior_cov(
    form: Form,
    P: Float[Array, "run n n"],
    c: Correction,
    H: Float[Array, "run m n"],
    R: Float[Array, "... m m"],
) -> Float[Array, "run n n"]:
    """P⁺ in the tangent at x̂⁻; the caller symmetrizes it.

    `joseph` is (I - K H) P (I - K H)ᵀ + K R Kᵀ (Bishop, eq. 19) and keeps P positive definite under
    rounding; `simplified` is (I - K H) P (eq. 21), `symmetric` P - K S Kᵀ (source 003, eq. 8).
    """
    if form == "symmetric":
        return P - c.reduction
    if form == "simplified":
        return (identity(P.shape[-1]) - c.gain @ H) @ P
    return joseph(P, c.gain, H, R)


def joseph(
    P: Float[Array, "run n n"],
    K: Float[Array, "run n m"],
    H: Float[Array, "run m n"],
    R: Float[Array, "... m m"],
) -> Float[Array, "run n n"]:
    """(I - K H) P (I - K H)ᵀ + K R Kᵀ, which holds for any gain K (Bishop, eq. 19).

    A component that did not arrive has a zero column in K, so H and R need no mask.
    """
    A = identity(P.shape[-1]) - K @ H
    return A @ P @ A.mT + K @ R @ K.mT


def without_absent(
    residual: Float[Array, "run m"],
    H: Float[Array, "run m n"],
    R: Float[Array, "... m m"],
    mask: Bool[Mask, "run m"] | None,
) -> tuple[Float[Array, "run m"], Float[Array, "run m n"], Float[Array, "... m m"]]:
    """ν, H and R without the components that did not arrive.

    Such a component gets a zero residual, a zero row of H, and independent noise of variance 1.

    Args:
        residual: ν.
        H: measurement Jacobian.
        R: measurement noise covariance.
        mask: True where a component arrived; None if all did.
    """
    if mask is None or mask.all():
        return residual, H, R
    return np.where(mask, residual, 0.0), np.where(mask[..., None], H, 0.0), pad_absent(R, mask)
