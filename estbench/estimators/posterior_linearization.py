"""Conditioning on a measurement by iterated statistical linearization (García-Fernández 2015).

All is written in whitened coordinates of the prior, x = x̂⁻ ⊞ L η with P⁻ = L Lᵀ and η ~ N(0, I), so
that no inverse of P⁻ is needed and P⁻ may be singular.
"""

from dataclasses import dataclass, replace

import numpy as np

from estbench.estimators.linear import joseph
from estbench.estimators.no_return import extended
from estbench.estimators.protocol import Innovation
from estbench.estimators.sigma_points import SigmaPoints
from estbench.estimators.update import correct
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Faults, Float, Mask, UInt
from estbench.spaces.linalg import cholesky, identity, solve_lower_transposed, symmetrize


@dataclass(frozen=True, eq=False)
class Whitened:
    """The posterior N(η, C) in whitened coordinates of the prior.

    Attributes:
        mean: η.
        cov: C.
        innovation: of the first linearization, which is that about the prior.
        fault: `Fault.INNOVATION` where S has no Cholesky factor.
    """

    mean: Float[Array, "run n"]
    cov: Float[Array, "run n n"]
    innovation: Innovation
    fault: UInt[Faults, " run"]


@dataclass(frozen=True, eq=False)
class Measured:
    """A measurement with the arguments of `Estimator.update`, and the points to linearize it with.

    Attributes:
        y, u, t, channels, mask: as in `Estimator.update`.
        rule: the sigma points.
        omega: how often Ω is counted beyond once.
        iterations: maximal number of linearizations.
        tolerance: a run has converged when no η changes by more.
    """

    y: Float[Array, "run ny"]
    u: Float[Array, "run nu"]
    t: float
    channels: Channels
    mask: Bool[Mask, "run m"] | None
    rule: SigmaPoints
    omega: float
    iterations: int
    tolerance: float


def condition(
    model: Model,
    mean: Float[Array, "run nx"],
    root: Float[Array, "run n n"],
    measured: Measured,
) -> Whitened:
    """The posterior of x̂⁻ ⊞ L η given y, the measurement linearized about the posterior itself.

    From N(η₀, C₀) = N(0, I), with C = G Gᵀ: points η + G ξ, the regression h ≈ ŷ ⊞ (A ξ + e) with
    Cov(e) = Ω, H = A G⁻¹, ν = (y ⊖ ŷ) + H η, S = H Hᵀ + (1 + ω) Ω + R, K = Hᵀ S⁻¹, then η = K ν and
    C = (I - K H)(I - K H)ᵀ + K ((1 + ω) Ω + R) Kᵀ. One linearization is the sigma-point filter.

    Source: García-Fernández, Svensson, Morelande & Särkkä, IEEE Trans. Signal Processing 63(20),
    2015.

    Args:
        model: the filter's model.
        mean: x̂⁻.
        root: L, any square root of P⁻.
        measured: the measurement and how to linearize it.
    """
    y, u, t, channels = measured.y, measured.u, measured.t, measured.channels
    space, output, rule = model.space, model.output(channels), measured.rule
    R = model.measurement_noise(t, channels)
    eta, factor = np.zeros(root.shape[:-1]), np.broadcast_to(identity(space.n), root.shape)
    cov, fault, active = factor, np.zeros(len(y), np.uint8), np.ones(len(y), bool)
    innovation, gain = None, None
    for iteration in range(measured.iterations):
        points = eta[:, None] + rule.points @ factor.mT
        states = space.plus(mean[:, None], points @ root.mT)
        images = model.measurement(states, u, t, channels)
        images, mask = extended(space, output, states, images, measured.mask)
        predicted, residuals, spread = rule.moments(output, images)
        slope, unexplained = rule.regress(residuals, spread)
        noise = symmetrize((1.0 + measured.omega) * unexplained + R)
        H = solve_lower_transposed(factor, slope.mT).mT if iteration else slope
        residual = output.minus(y, predicted) + (H @ eta[..., None])[..., 0]
        c = correct(residual, symmetrize(H @ H.mT + noise), H.mT, mask)
        innovation, gain = innovation or c.innovation, c.gain
        moved = np.abs(c.delta - eta).max(axis=-1, initial=0.0)
        new = symmetrize(joseph(np.broadcast_to(identity(space.n), root.shape), c.gain, H, noise))
        eta = np.where(active[:, None], c.delta, eta)
        cov = np.where(active[:, None, None], new, cov)
        fault = np.where(active, c.fault, fault)
        active = active & (moved > measured.tolerance)
        if iteration + 1 == measured.iterations or not active.any():
            break
        factor = cholesky(cov)
    assert innovation is not None
    assert gain is not None
    innovation = replace(innovation, gain=root @ gain)  # of the state, in the last linearization
    return Whitened(eta, cov, innovation, fault)
