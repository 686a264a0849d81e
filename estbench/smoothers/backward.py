"""One step backwards of a Rauch-Tung-Striebel smoother, in square-root form.

With the factor [[X, 0], [Y, Z]] of the joint covariance of (x₊, x) the gain is G = Y X⁻¹, and Z Zᵀ
is the covariance of x given x₊, P - G P⁻ Gᵀ without a difference (Park & Kailath 1995,
"Square-root RTS smoothing algorithms", Int. J. Control 62(5)). P and P⁻ may be singular, and much
larger than what the smoother makes of them.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.errors import DimensionError
from estbench.estimators.beliefs import Fault, Gaussian
from estbench.estimators.factors import FactorBelief, triangular
from estbench.estimators.update import apply_correction
from estbench.shapes import Array, Float
from estbench.spaces.linalg import identity, solve_lower_transposed, symmetrize
from estbench.spaces.manifold import Manifold
from estbench.spaces.semidefinite import RESOLUTION, range_root

_PIVOT = 1e-13
"""Pivot of X, relative to the standard deviation, up to which X counts as singular."""


def square_root(belief: Any) -> Float[Array, "run n n"]:
    """A square root of the belief's covariance: the filter's own factor, if it has one."""
    return belief.factor if isinstance(belief, FactorBelief) else range_root(belief.cov)


def resolution(space: Manifold, posteriors: Sequence[Any]) -> Float[Array, "run n"]:
    """Standard deviation of each coordinate up to which the smoother takes it as known exactly."""
    return RESOLUTION * np.max([space.magnitude(belief.mean) for belief in posteriors], axis=0)


def joint_factor(
    slope: Float[Array, "run n n"],
    root: Float[Array, "run n n"],
    noise: Float[Array, "... n n"],
) -> Float[Array, "run both both"]:
    """[[X, 0], [Y, Z]] of x₊ = F x + w: the triangle of [[F L, N], [L, 0]].

    Args:
        slope: F.
        root: L, a square root of P.
        noise: N, a square root of Q.
    """
    n = root.shape[-1]
    joint = np.zeros((len(root), 2 * n, 2 * n))
    joint[:, :n, :n], joint[:, n:, :n], joint[:, :n, n:] = slope @ root, root, noise
    return triangular(joint)


def smooth_step(
    space: Manifold,
    now: Gaussian,
    mean: Float[Array, "run nx"],
    joint: Float[Array, "run both both"],
    later: Gaussian,
    known: Float[Array, "run n"],
) -> Gaussian:
    """x̂ˢ = x̂ ⊞ G (x̂ˢ₊ ⊖ x̂⁻), Pˢ = Z Zᵀ + G Pˢ₊ Gᵀ.

    Args:
        space: the state's manifold.
        now: the filter's posterior.
        mean: x̂⁻ of the next time.
        joint: [[X, 0], [Y, Z]], lower triangular.
        later: the smoothed belief of the next time; its covariance is first mapped to the tangent
            at x̂⁻, and the result to that at x̂ˢ.
        known: `resolution`.
    """
    n = space.n
    Y, Z = joint[:, n:, :n], joint[:, n:, n:]
    gain, rest = backward_gain(joint[:, :n, :n], Y, known)
    ahead = space.minus(later.mean, mean)
    after = space.transport(later.cov, space.minus(mean, later.mean))
    delta = (gain @ ahead[..., None])[..., 0]
    cov = symmetrize(Z @ Z.mT + rest @ rest.mT + gain @ after @ gain.mT)
    indefinite = ~np.isfinite(joint[:, -1, -1]) & np.isfinite(now.cov).all(axis=(-2, -1))
    fault = np.where(later.fault, later.fault, np.where(indefinite, Fault.COVARIANCE, Fault.NONE))
    return apply_correction(space, now, delta, cov, fault.astype(np.uint8))


def backward_gain(
    X: Float[Array, "run n n"], Y: Float[Array, "run n n"], known: Float[Array, "run n"]
) -> tuple[Float[Array, "run n n"], Float[Array, "run n n"]]:
    """G with G X Xᵀ = Y Xᵀ, and Y - G X, which is zero where X is regular.

    Where X is singular G is Y X⁺, with the pseudo-inverse by singular values of X whose rows are
    divided by their standard deviations, so that units do not matter.

    Args:
        X: factor of P⁻.
        Y: Y Xᵀ is the covariance of x and x₊.
        known: standard deviation up to which a coordinate of x₊ is known exactly.
    """
    variance = np.vecdot(X, X)
    floor = known**2
    regular = np.diagonal(X, axis1=-2, axis2=-1) ** 2 > np.maximum(_PIVOT**2 * variance, floor)
    few = ~regular.all(axis=-1) & np.isfinite(X).all(axis=(-2, -1))
    safe = np.where(few[:, None, None], identity(X.shape[-1]), X) if few.any() else X
    gain, rest = solve_lower_transposed(safe, Y.mT).mT, np.zeros_like(Y)
    if few.any():
        X, Y, variance, floor = X[few], Y[few], variance[few], floor[few]
        exact = variance <= floor
        std = np.sqrt(np.where(exact, 1.0, variance))
        U, size, Vt = np.linalg.svd(np.where(exact[..., None], 0.0, X / std[..., None]))
        unsure = (U**2 * np.where(exact, 0.0, floor / std**2)[..., None]).sum(axis=-2)
        kept = size**2 > np.maximum(_PIVOT**2, unsure)
        along = np.where(kept[:, None], Y @ Vt.mT, 0.0)
        gain[few] = along / np.where(kept, size, 1.0)[:, None] @ U.mT / std[:, None]
        rest[few] = Y - along @ Vt
    return gain, rest


def gaussian(belief: Any) -> Gaussian:
    """A belief with mean, cov and fault as a plain `Gaussian`."""
    return Gaussian(belief.mean, belief.cov, belief.fault)


def check_lengths(
    states: Sequence[Any], controls: Sequence[Float[Array, "run nu"]], times: Sequence[float]
) -> None:
    """Raise unless there is one state per time, and one control less."""
    if not len(states) == len(times) == len(controls) + 1:
        raise DimensionError(
            f"{len(states)} beliefs, {len(controls)} controls and {len(times)} times do not fit; "
            "give K + 1 beliefs, K controls and K + 1 times"
        )
