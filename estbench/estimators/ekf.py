"""Extended Kalman filter, discrete (Bishop, eq. 11, 17, 19-21; source 001; source 003, eq. 6-8)."""

from dataclasses import dataclass

from estbench.estimators.beliefs import Gaussian, GaussianEstimator
from estbench.estimators.linear import FORMS, Form, linear_update, predicted_cov
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import has_model, one_of
from estbench.estimators.update import mark_failed
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Mask


@dataclass(frozen=True)
class EKF(GaussianEstimator):
    """Extended Kalman filter: the model linearized about the current estimate.

    Cost per step: n + 1 transitions and n + 1 measurements with forward differences. Choose it
    first: it is cheap, and accurate while the model is nearly linear over the error.

    Attributes:
        model: the filter's model.
        covariance_update: `joseph` (keeps P positive definite under rounding), `simplified` or
            `symmetric`; see `estbench.estimators.linear.posterior_cov`.
    """

    model: Model
    covariance_update: Form = "joseph"

    def __post_init__(self) -> None:
        has_model(self)
        one_of(self, "covariance_update", FORMS)

    def predict(self, belief: Gaussian, u: Float[Array, "run nu"], t: float, dt: float) -> Gaussian:
        """x̂⁻ = f(x̂⁺, u), P⁻ = Φ P⁺ Φᵀ + Q (Bishop, eq. 11)."""
        mean, F = self.model.transition_jacobian(belief.mean, u, t, dt)
        Q = self.model.process_noise(belief.mean, u, t, dt)
        return mark_failed(belief.moved(mean, predicted_cov(F, belief.cov, Q)))

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """x̂⁺ = x̂⁻ ⊞ K (y ⊖ h(x̂⁻)), K = P⁻ Hᵀ S⁻¹ (Bishop, eq. 17, 20)."""
        predicted, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        R = self.model.measurement_noise(t, channels)
        residual = self.model.output(channels).minus(y, predicted)
        return linear_update(self.model.space, belief, residual, H, R, mask, self.covariance_update)
