"""Square-root extended Kalman filter in array form (Kailath, Sayed & Hassibi 2000, ch. 12)."""

from dataclasses import dataclass

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
    triangular,
)
from estbench.estimators.no_return import returned
from estbench.estimators.protocol import Innovation
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.semidefinite import psd_root


@dataclass(frozen=True)
class SquareRootEKF(FactorEstimator):
    """Square-root EKF: it propagates a triangular factor L of P = L Lᵀ, so P stays definite.

    Both steps triangularize an array by QR. P and S are not formed, so the factor has twice the
    number of correct digits. It equals the EKF up to rounding.

    Cost per step: as the EKF, n + 1 transitions and n + 1 measurements with forward differences,
    and QR in place of products. Choose it where P is ill-conditioned: very precise sensors together
    with very uncertain states, long runs, or a covariance fault of another filter.

    Attributes:
        model: the filter's model.
    """

    model: Model

    def predict(
        self, belief: FactorBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> FactorBelief:
        """x̂⁻ = f(x̂⁺, u); L⁻ from QR of [Φ L⁺, Q^½]."""
        mean, F = self.model.transition_jacobian(belief.mean, u, t, dt)
        Q = self.model.process_noise(belief.mean, u, t, dt)
        noise = np.broadcast_to(psd_root(Q), F.shape)
        factor = triangular(np.concatenate([F @ belief.factor, noise], axis=-1))
        return factor_belief(mean, factor, belief.fault, lost(noise, np.broadcast_to(Q, F.shape)))

    def update(
        self,
        belief: FactorBelief,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[FactorBelief, Innovation]:
        """QR transforms [[R^½, H L⁻], [0, L⁻]] to [[S^½, 0], [K S^½, L⁺]]; x̂⁺ = x̂⁻ ⊞ K ν."""
        predicted, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        R = self.model.measurement_noise(t, channels)
        residual = self.model.output(channels).minus(y, predicted)
        mask = returned(residual, mask)
        seen = H @ belief.factor
        if mask is not None:
            residual = np.where(mask, residual, 0.0)
            seen = np.where(mask[:, :, None], seen, 0.0)
        runs, m, n = seen.shape
        noise = noise_root(R, mask, runs)
        array = np.zeros((runs, m + n, m + n))
        array[:, :m, :m], array[:, :m, m:], array[:, m:, m:] = noise, seen, belief.factor
        array = triangular(array)
        innovation = factor_innovation(residual, array[:, :m, :m], array[:, m:, :m], mask)
        delta = (array[:, m:, :m] @ innovation.white[..., None])[..., 0]
        fault = lost(noise, np.broadcast_to(R, noise.shape), Fault.INNOVATION)
        posterior = factor_settle(self.model.space, belief, delta, array[:, m:, m:], fault)
        return posterior, innovation
