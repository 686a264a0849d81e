"""Square-root unscented Kalman filter (van der Merwe & Wan, ICASSP 2001, algorithm 3.1)."""

from dataclasses import dataclass, field

import numpy as np

from estbench.estimators.beliefs import Fault
from estbench.estimators.factors import (
    FactorBelief,
    FactorEstimator,
    cholesky_update,
    factor_belief,
    factor_innovation,
    factor_settle,
    lost,
    noise_root,
    psd_root,
    triangular,
)
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import scaled_rule
from estbench.estimators.sigma_points import SigmaPoints, scaled
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import solve_lower


@dataclass(frozen=True)
class SquareRootUKF(FactorEstimator):
    """Square-root UKF: it propagates a triangular factor of P and redraws points before the update.

    The factor of Σ wᵢ rᵢ rᵢᵀ + Q is the QR of the equally weighted residuals and Q^½, then a
    rank-one update with the residual of the centre, whose weight may be negative. A measurement
    subtracts K S^½ from L by one downdate per component. It equals the UKF up to rounding.

    Cost per step: 2 n + 1 transitions and 2 n + 1 measurements, no Cholesky factorization of P.
    Choose it over the UKF where P is ill-conditioned.

    Attributes:
        model: the filter's model.
        alpha, beta, kappa: of the scaled rule, as in `UKF`; at the default 1, 2, 0 the covariance
            weight of the centre is 2, and the prediction needs no downdate.
    """

    model: Model
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0
    rule: SigmaPoints = field(init=False, repr=False)

    def __post_init__(self) -> None:
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
        factor = self._factor(residuals, np.broadcast_to(psd_root(Q), belief.factor.shape))
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
        """K = (Pxy S^-ᵀ½) S^-½; L⁺ is L⁻ downdated by K S^½ (algorithm 3.1)."""
        space, output = self.model.space, self.model.output(channels)
        points = self.rule.draw(space, belief.mean, belief.factor)
        images = self.model.measurement(points, u, t, channels)
        predicted, residuals = self.rule.residuals(output, images)
        residual = output.minus(y, predicted)
        if mask is not None:
            residual = np.where(mask, residual, 0.0)
            residuals = np.where(mask[:, None, :], residuals, 0.0)
        root = noise_root(self.model.measurement_noise(t, channels), mask, len(y))
        root = self._factor(residuals, root)
        innovation = factor_innovation(residual, root, mask)
        spread = self.rule.points @ belief.factor.mT
        cross = self.rule.cross(spread, residuals)
        W = solve_lower(root, cross.mT)  # (K S^½)ᵀ
        delta = (innovation.white[:, None] @ W)[:, 0]
        factor = belief.factor
        for component in range(W.shape[1]):
            factor = cholesky_update(factor, W[:, component], -1.0)
        unseen = lost(root, residuals, Fault.INNOVATION)
        fault = np.where(unseen, unseen, lost(factor, W))
        return factor_settle(space, belief, delta, factor, fault), innovation

    def _factor(self, residuals: Array, noise: Array) -> Array:
        """The factor of Σ wᵢ rᵢ rᵢᵀ + N Nᵀ; the first residual is that of the centre."""
        weights = self.rule.cov_weights
        columns = np.swapaxes(np.sqrt(weights[1]) * residuals[:, 1:], -1, -2)
        factor = triangular(np.concatenate([columns, noise], axis=-1))
        return cholesky_update(factor, residuals[:, 0], float(weights[0]))
