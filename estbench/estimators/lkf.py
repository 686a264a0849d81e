"""Linearized Kalman filter about a nominal trajectory (source 002, Ahmed, ASEN 5044 lecture 32)."""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from estbench.estimators.beliefs import Gaussian, GaussianEstimator
from estbench.estimators.kf import tangent_map
from estbench.estimators.linear import linear_update, predicted_cov
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import in_range
from estbench.estimators.update import mark_failed
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.semidefinite import range_form


@dataclass(frozen=True, eq=False)
class NominalBelief(Gaussian):
    """A Gaussian with the nominal state of the linearization; the deviation is x̂ ⊖ x*.

    Attributes:
        nominal: x*.
        handed: whether the run has been handed over to the EKF.
    """

    nominal: Float[Array, "run nx"]
    handed: Bool[Mask, " run"]


@dataclass(frozen=True)
class LKF(GaussianEstimator):
    """Linearized KF: estimates the deviation from a nominal trajectory; may hand over to the EKF.

    The nominal x* starts at the initial mean and follows the model under the same controls without
    noise. Both mean and covariance use the linearization about it (source 002, "linearized KF"):
    x̂⁻ = f(x*, u) ⊞ Φ (x̂⁺ ⊖ x*), ŷ = h(x*, u) ⊞ H (x̂⁻ ⊖ x*). The gains do not depend on the
    measurements. After the hand-over of a run x* = x̂, which is the EKF.

    Cost per step: n + 1 transitions and n + 1 measurements with forward differences. Choose it
    where the robot stays close to its nominal trajectory, or to start an EKF from a poor initial
    estimate.

    Attributes:
        model: the filter's model.
        handover_time: time from which every run is an EKF, s; None for never.
        handover_sigma: bound on sqrt(δᵀ P⁻¹ δ), with the deviation δ = x̂ ⊖ x*; a run that exceeds
            it is an EKF from then on. None for never.
    """

    model: Model
    handover_time: float | None = None
    handover_sigma: float | None = None

    def __post_init__(self) -> None:
        if self.handover_time is not None:
            in_range(self, "handover_time", 0.0)
        if self.handover_sigma is not None:
            in_range(self, "handover_sigma", 0.0)

    @property
    def depends_on_time(self) -> bool:
        """Whether what is computed depends on the time: with `handover_time` it does."""
        return self.handover_time is not None

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> NominalBelief:
        """Start from N(mean, cov); the mean is also the nominal state."""
        start = super().init(mean, cov)
        return NominalBelief(
            start.mean, start.cov, start.fault, start.mean, np.zeros(len(mean), bool)
        )

    def predict(
        self, belief: NominalBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> NominalBelief:
        """Propagate x*, x̂⁻ and P⁻ = Φ P⁺ Φᵀ + Q, with Φ and Q at x*."""
        model, belief = self.model, self._handed_over(belief, t)
        nominal, slope = model.transition_jacobian(belief.nominal, u, t, dt)
        mean, F = tangent_map(model.space, model.space, belief.mean, belief.nominal, nominal, slope)
        Q = model.process_noise(belief.nominal, u, t, dt)
        cov = predicted_cov(F, belief.cov, Q)
        return cast(
            NominalBelief, mark_failed(replace(belief, mean=mean, cov=cov, nominal=nominal))
        )

    def update(
        self,
        belief: NominalBelief,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[NominalBelief, Innovation]:
        """x̂⁺ = x̂⁻ ⊞ K (y ⊖ ŷ), K from H at x*; x* does not change."""
        model, belief = self.model, self._handed_over(belief, t)
        output = model.output(channels)
        image, slope = model.measurement_jacobian(belief.nominal, u, t, channels)
        predicted, H = tangent_map(model.space, output, belief.mean, belief.nominal, image, slope)
        R = model.measurement_noise(t, channels)
        return linear_update(model.space, belief, output.minus(y, predicted), H, R, mask)

    def _handed_over(self, belief: NominalBelief, t: float) -> NominalBelief:
        """Hand over the runs that are due; x* of every run handed over is set to x̂."""
        handed = belief.handed
        if self.handover_time is not None and t >= self.handover_time - 1e-9:
            handed = np.ones_like(handed)
        if self.handover_sigma is not None and not handed.all():
            # δ is an eigenvector of the reset Jacobian (eigenvalue 1): the same at x* and at x̂.
            delta = self.model.space.minus(belief.mean, belief.nominal)
            form = range_form(belief.cov, delta, np.zeros_like(delta))
            handed = handed | (form.value > self.handover_sigma**2)
        if not handed.any():
            return belief
        nominal = np.where(handed[:, None], belief.mean, belief.nominal)
        return replace(belief, nominal=nominal, handed=handed)
