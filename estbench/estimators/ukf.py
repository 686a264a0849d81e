"""Unscented Kalman filter, additive noise (source 003, eq. 10-11; van der Merwe 2004, alg. 3.1)."""

from dataclasses import dataclass, field, replace

import numpy as np

from estbench.estimators.beliefs import Fault, Gaussian, GaussianEstimator
from estbench.estimators.no_return import extended
from estbench.estimators.points import points_update
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import has_model, scaled_rule, switch
from estbench.estimators.sigma_points import SigmaPoints, scaled
from estbench.estimators.update import apply_correction, mark_failed
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Faults, Float, Mask, UInt
from estbench.spaces.linalg import symmetrize

PREDICTION, MEASUREMENT = range(2)
"""What sigma points are drawn for."""


@dataclass(frozen=True, eq=False)
class SigmaBelief(Gaussian):
    """A Gaussian with the propagated points and the covariance that was added to theirs.

    Both are None after an update, and if the points are redrawn.
    """

    points: Float[Array, "run point nx"] | None = None
    noise: Float[Array, "*lead n n"] | None = None


@dataclass(frozen=True)
class SigmaPointFilter(GaussianEstimator):
    """A Gaussian filter with any sigma-point rule; the UKF and the cubature filters set `rule`.

    Attributes:
        model: the filter's model.
        redraw: whether new points are drawn from x̂⁻, P⁻ before the measurement update (source 003,
            eq. 11), so that their spread includes the process noise; otherwise the propagated
            points are used, and Q enters the update through P⁻ only.
        omega: how often Ω, the covariance of the linearization error, is added to P⁻ and to S of
            redrawn points; a subclass may make it a setting.
        rule: the sigma points; those of one step are `rule_at`.
    """

    model: Model
    redraw: bool = True
    omega: float = field(init=False, repr=False, default=0.0)
    rule: SigmaPoints = field(init=False, repr=False)

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> Gaussian:
        """Start from N(mean, cov)."""
        start = super().init(mean, cov)
        return SigmaBelief(start.mean, start.cov, start.fault)

    def predict(self, belief: Gaussian, u: Float[Array, "run nu"], t: float, dt: float) -> Gaussian:
        """x̂⁻ and P⁻ from the propagated points, P⁻ += Q (source 003, eq. 10)."""
        rule = self.rule_at(belief, PREDICTION)
        points, spread = rule.around(self.model.space, belief.mean, belief.cov)
        points = self.model.transition(points, u, t, dt)
        mean, residual, cov = rule.moments(self.model.space, points)
        noise = self.model.process_noise(belief.mean, u, t, dt)
        if self.omega:
            noise = noise + self.omega * rule.regress(residual, cov)[1]
        kept = {}
        if not self.redraw:
            kept = {"points": self.rule.on_line(self.model.space, points), "noise": noise}
        prior = replace(belief, mean=mean, cov=symmetrize(cov + noise), **kept)
        return self.drawn(mark_failed(prior, failed_factor(spread, belief.cov)))

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """x̂⁺ and P⁺ = P⁻ - K S Kᵀ with Pxy, S from the points' images (source 003, eq. 11).

        What S and P⁻ contain beside the points' covariance is treated as R and as noise of x̂⁻.
        """
        space, output = self.model.space, self.model.output(channels)
        fault = np.zeros(len(y), np.uint8)
        points, noise = getattr(belief, "points", None), getattr(belief, "noise", None)
        redrawn, rule = points is None, self.rule_at(belief, MEASUREMENT)
        if points is None:
            points, spread = rule.around(space, belief.mean, belief.cov)
            fault = failed_factor(spread, belief.cov)
        else:
            spread = space.line.minus(points, belief.mean[:, None])
        images = self.model.measurement(points, u, t, channels)
        images, mask = extended(space, output, points, images, mask)
        predicted, residuals, S = rule.moments(output, images)
        R = self.model.measurement_noise(t, channels)
        if self.omega and redrawn:
            R = R + self.omega * rule.regress(residuals, S)[1]
        found = points_update(rule, output.minus(y, predicted), spread, residuals, S, R, mask)
        cov = found.cov if noise is None else symmetrize(found.cov + noise)
        prior = belief if redrawn else replace(belief, points=None, noise=None)
        fault = np.where(fault, fault, found.fault)
        posterior = apply_correction(space, prior, found.delta, cov, fault)
        return self.drawn(posterior, found.innovation), found.innovation

    def rule_at(self, belief: Gaussian, purpose: int) -> SigmaPoints:
        """The sigma points for one belief and one purpose, PREDICTION or MEASUREMENT."""
        return self.rule

    def drawn(self, belief: Gaussian, innovation: Innovation | None = None) -> Gaussian:
        """The belief after a prediction or an update, for which points were drawn.

        A filter with random points counts here, so that those of the next step are others.
        """
        return belief


def failed_factor(
    factor: Float[Array, "run k n"], cov: Float[Array, "run n n"]
) -> UInt[Faults, " run"]:
    """`Fault.COVARIANCE` where a finite covariance has no square root: it or its points are NaN."""
    failed = ~np.isfinite(factor[:, 0, 0]) & np.isfinite(cov[:, 0, 0])
    return np.where(failed, Fault.COVARIANCE, Fault.NONE).astype(np.uint8)


@dataclass(frozen=True)
class UKF(SigmaPointFilter):
    """Unscented Kalman filter, by the scaled transform.

    Cost per step: 2 n + 1 transitions and 2 n + 1 measurements. Choose it where the EKF is
    overconfident because the model is nonlinear within one standard deviation, or where the model
    has no usable derivative.

    Attributes:
        alpha: spread of the points, in (0, 1]; at the default 1 no weight is large, so P stays
            positive definite. Small values (1e-3) give large weights of opposite sign.
        beta: 2 is optimal for a Gaussian.
        kappa: secondary spread; n + κ must be positive.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        has_model(self)
        scaled_rule(self)
        switch(self, "redraw")
        object.__setattr__(
            self, "rule", scaled(self.model.space.n, self.alpha, self.beta, self.kappa)
        )
