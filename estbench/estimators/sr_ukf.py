"""Square-root unscented Kalman filter (van der Merwe & Wan, ICASSP 2001, algorithm 3.1)."""

from dataclasses import dataclass, field

import numpy as np

from estbench.estimators.beliefs import Fault
from estbench.estimators.factors import (
    FactorBelief,
    FactorEstimator,
    factor_belief,
    factor_innovation,
    factor_settle,
    lost,
    noise_root,
    weighted_factor,
)
from estbench.estimators.no_return import extended
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import has_model, scaled_rule
from estbench.estimators.sigma_points import SigmaPoints, scaled
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.semidefinite import psd_root


@dataclass(frozen=True)
class SquareRootUKF(FactorEstimator):
    """Square-root UKF: it propagates a triangular factor of P and redraws points before the update.

    The factor of Σ wᵢ rᵢ rᵢᵀ + Q is the QR of the weighted residuals and Q^½. The update
    triangularizes the array of the points and their images, as the square-root Kalman filter does
    (Kailath, Sayed & Hassibi 2000, ch. 12), in place of the source's downdate of L⁻ by K S^½, which
    loses the digits of L⁺ where that is much smaller than L⁻. Where the weight of the centre is
    negative its residual follows as a rank-one downdate. It equals the UKF up to rounding.

    Cost per step: 2 n + 1 transitions and 2 n + 1 measurements, no Cholesky factorization of P.
    Choose it over the UKF where P is ill-conditioned.

    Attributes:
        model: the filter's model.
        alpha, beta, kappa: of the scaled rule, as in `UKF`; at the default 1, 2, 0 the covariance
            weight of the centre is 2, and no downdate is needed.
    """

    model: Model
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0
    rule: SigmaPoints = field(init=False, repr=False)

    def __post_init__(self) -> None:
        has_model(self)
        scaled_rule(self)
        rule = scaled(self.model.space.n, self.alpha, self.beta, self.kappa)
        object.__setattr__(self, "rule", rule)

    def predict(
        self, belief: FactorBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> FactorBelief:
        """x̂⁻ and L⁻ from the propagated points, time update of algorithm 3.1."""
        space = self.model.space
        points = self.rule.draw(space, belief.mean, belief.factor)
        points = self.model.transition(points, u, t, dt)
        mean, residuals = self.rule.residuals(space, points)
        Q = self.model.process_noise(belief.mean, u, t, dt)
        noise = np.broadcast_to(psd_root(Q), belief.factor.shape)
        factor = weighted_factor(self.rule.cov_weights, residuals, noise)
        return factor_belief(mean, factor, belief.fault, lost(factor, residuals))

    def update(
        self,
        belief: FactorBelief,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[FactorBelief, Innovation]:
        """The factor of [ν; x ⊖ x̂⁻] is [[S^½, 0], [K S^½, L⁺]]; x̂⁺ = x̂⁻ ⊞ K ν."""
        space, output = self.model.space, self.model.output(channels)
        spread = self.rule.points @ belief.factor.mT
        points = space.plus(belief.mean[:, None], spread)
        images = self.model.measurement(points, u, t, channels)
        images, mask = extended(space, output, points, images, mask)
        predicted, residuals = self.rule.residuals(output, images)
        residual = output.minus(y, predicted)
        if mask is not None:
            residual = np.where(mask, residual, 0.0)
            residuals = np.where(mask[:, None, :], residuals, 0.0)
        runs, m = residual.shape
        noise = np.zeros((runs, m + space.n, m))
        noise[:, :m] = noise_root(self.model.measurement_noise(t, channels), mask, runs)
        both = np.concatenate([residuals, spread], axis=-1)
        joint = weighted_factor(self.rule.cov_weights, both, noise)
        innovation = factor_innovation(residual, joint[:, :m, :m], joint[:, m:, :m], mask)
        delta = (joint[:, m:, :m] @ innovation.white[..., None])[..., 0]
        factor = joint[:, m:, m:]
        unseen = lost(joint[:, :m, :m], residuals, Fault.INNOVATION)
        fault = np.where(unseen, unseen, lost(factor, spread))
        return factor_settle(space, belief, delta, factor, fault), innovation
