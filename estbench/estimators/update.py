"""The measurement update of the Gaussian filters: condition, correct, mark failures."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from estbench.estimators.beliefs import Fault, Gaussian
from estbench.estimators.no_return import returned
from estbench.estimators.protocol import Gain, Innovation
from estbench.shapes import Array, Bool, Faults, Float, Mask, UInt
from estbench.spaces import fused
from estbench.spaces.linalg import cholesky, identity, pad_absent, solve_lower, surely_finite
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class Correction:
    """The linear estimate of the error from an innovation: δ = K ν.

    The gain K and the reduction K S Kᵀ are computed when a filter asks for them.

    Attributes:
        delta: K ν.
        innovation: ν, S, NIS and K.
        fault: `Fault.INNOVATION` where S has no Cholesky factor.
        white: W = L⁻¹ Pxyᵀ, with S = L Lᵀ.
        whitening: L⁻¹.
    """

    delta: Float[Array, "run n"]
    innovation: Innovation
    fault: UInt[Faults, " run"]
    white: Float[Array, "run m n"]
    whitening: Float[Array, "run m m"]

    @cached_property
    def gain(self) -> Float[Array, "run n m"]:
        """The gain K = Wᵀ L⁻¹."""
        return self.white.mT @ self.whitening

    @cached_property
    def reduction(self) -> Float[Array, "run n n"]:
        """The reduction of P by the update, K S Kᵀ = Wᵀ W."""
        return self.white.mT @ self.white


def correct(
    residual: Float[Array, "run m"],
    S: Float[Array, "run m m"],
    cross: Float[Array, "run n m"],
    mask: Bool[Mask, "run m"] | None = None,
) -> Correction:
    """Condition on an innovation: K = Pxy S⁻¹ by Cholesky (source 003, eq. 3-4; Bishop, eq. 20).

    With S = L Lᵀ and W = L⁻¹ Pxyᵀ: K ν = Wᵀ (L⁻¹ ν), NIS = |L⁻¹ ν|².
    A component that did not arrive has no effect: its cross-covariance and residual are set to
    zero, its row and column of S to those of the identity. So is one of which no return is
    predicted (an infinite residual).

    Args:
        residual: ν.
        S: innovation covariance, including R.
        cross: Pxy (P Hᵀ for a linear measurement).
        mask: True where a component arrived; None if all did.
    """
    m, n = S.shape[-1], cross.shape[-2]
    if mask is not None and not mask.all():
        S = pad_absent(S, mask)
        cross = np.where(mask[:, None, :], cross, 0.0)
        residual = np.where(mask, residual, 0.0)
        dof = mask.sum(axis=-1)
    else:
        dof = np.array([m]).repeat(len(S))
    lower = cholesky(S)
    joint = np.zeros((len(S), m, n + 1 + m))
    joint[..., :n], joint[..., n], joint[..., n + 1 :] = cross.mT, residual, identity(m)
    joint = solve_lower(lower, joint)
    W, white = joint[..., :n], joint[..., n]
    delta = (W.mT @ white[..., None])[..., 0]
    nis = np.vecdot(white, white)
    fault = np.zeros(len(S), np.uint8)
    if not surely_finite(nis):
        present = returned(residual, mask)
        if present is not mask:
            return correct(residual, S, cross, present)
        factored = np.isfinite(lower[:, 0, 0])
        fault[~factored & np.isfinite(S).all(axis=(-2, -1))] = Fault.INNOVATION
    innovation = Innovation(residual, S, white, nis, dof, lower, gain=Gain(W.mT, lower))
    return Correction(delta, innovation, fault, W, joint[..., n + 1 :])


@dataclass(frozen=True, eq=False)
class Update:
    """What an update changes.

    Attributes:
        delta: K ν.
        cov: P⁺ in the tangent at x̂⁻.
        innovation: ν, S, NIS and K.
        fault: why a run failed, else `Fault.NONE`.
    """

    delta: Float[Array, "run n"]
    cov: Float[Array, "run n n"]
    innovation: Innovation
    fault: UInt[Faults, " run"]


def looped(
    loop: fused.Updated | None,
    residual: Float[Array, "run m"],
    mask: Bool[Mask, "run m"] | None,
    numpy: Callable[[Any, Mask | None], Update],
) -> Update:
    """The update of a compiled loop, and numpy's in the runs which the loop could not judge.

    These are the ones where a component did not arrive, and those with an S without a factor or an
    infinite residual. What happens in one run then changes no digit of another.

    Args:
        loop: None where numpy has to do all.
        residual: ν.
        mask: True where a component arrived; None if all did.
        numpy: the update of the runs of an index, by the mask of these.
    """
    if loop is None:
        return numpy(slice(None), mask)
    run, m = residual.shape
    left = None if mask is None else ~np.all(mask, axis=-1)
    if not surely_finite(loop.nis):
        lost = ~np.isfinite(loop.nis) & np.isfinite(loop.S).all(axis=(-2, -1))
        left = lost if left is None else left | lost
    fault, dof = np.zeros(run, np.uint8), np.array([m]).repeat(run)
    if left is not None and np.count_nonzero(left):
        part = numpy(left, None if mask is None else mask[left])
        inn, residual = part.innovation, residual.copy()
        assert isinstance(inn.gain, Gain)
        whole = (*loop, fault, dof, residual)
        rows = (
            *(part.delta, part.cov, inn.cov, inn.factor, inn.gain.scaled.mT, inn.white, inn.nis),
            *(part.fault, inn.dof, inn.residual),
        )
        for into, found in zip(whole, rows, strict=True):
            assert found is not None
            into[left] = found
    gain = Gain(loop.W.mT, loop.lower)
    innovation = Innovation(residual, loop.S, loop.white, loop.nis, dof, loop.lower, gain=gain)
    return Update(loop.delta, loop.cov, innovation, fault)


def apply_correction(
    space: Manifold,
    prior: Gaussian,
    delta: Float[Array, "run n"],
    cov: Float[Array, "run n n"],
    fault: UInt[Faults, " run"] | None = None,
) -> Gaussian:
    """The posterior x̂⁻ ⊞ δ, its covariance mapped to the tangent there; failed runs are marked."""
    return mark_failed(
        prior.moved(space.plus(prior.mean, delta), space.transport(cov, delta)), fault
    )


def mark_failed(belief: Gaussian, fault: UInt[Faults, " run"] | None = None) -> Gaussian:
    """Set every run that is not finite, or has a new `fault`, to NaN and record its fault."""
    failed = np.count_nonzero(belief.fault) or (fault is not None and np.count_nonzero(fault))
    if not failed and surely_finite(belief.mean, belief.cov):
        return belief
    finite = np.isfinite(belief.mean).all(axis=-1) & np.isfinite(belief.cov).all(axis=(-2, -1))
    code = np.where(finite, Fault.NONE, Fault.STATE).astype(np.uint8)
    if fault is not None:
        code = np.where(fault, fault, code)
    code = np.where(belief.fault, belief.fault, code)
    bad = code != Fault.NONE
    return replace(
        belief,
        mean=np.where(bad[:, None], np.nan, belief.mean),
        cov=np.where(bad[:, None, None], np.nan, belief.cov),
        fault=code,
    )
