"""Extended Kalman filter, discrete (Bishop, eq. 11, 17, 19-21; source 001; source 003, eq. 6-8)."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estbench.estimators.base import (
    Gaussian,
    GaussianEstimator,
    Innovation,
    correct,
    marked,
    settle,
)
from estbench.estimators.settings import one_of
from estbench.linalg import symmetrize
from estbench.models.base import Channels, Model

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EKF(GaussianEstimator):
    """Extended Kalman filter: the model linearized about the current estimate.

    Cost per step: n + 1 transitions and n + 1 measurements with forward differences. Choose it
    first: it is the cheapest, and right while the error stays small against the curvature.

    Attributes:
        model: the filter's model.
        covariance_update: `joseph` (Bishop eq. 19, keeps P positive definite under rounding),
            `simplified` (I - K H) P (eq. 21), or `symmetric` P - K S Kᵀ (source 003, eq. 8).
    """

    model: Model
    covariance_update: Literal["joseph", "simplified", "symmetric"] = "joseph"

    def __post_init__(self) -> None:
        one_of(self, "covariance_update", ("joseph", "simplified", "symmetric"))

    def predict(self, belief: Gaussian, u: Array, t: float, dt: float) -> Gaussian:
        """x̂⁻ = f(x̂⁺, u), P⁻ = Φ P⁺ Φᵀ + Q (Bishop, eq. 11)."""
        mean, F = self.model.transition_jacobian(belief.mean, u, t, dt)
        Q = self.model.process_noise(belief.mean, u, t, dt)
        cov = symmetrize(F @ belief.cov @ F.mT + Q)
        return marked(replace(belief, mean=mean, cov=cov))

    def update(
        self,
        belief: Gaussian,
        y: Array,
        u: Array,
        t: float,
        channels: Channels = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """x̂⁺ = x̂⁻ ⊞ K (y ⊖ h(x̂⁻)), K = P⁻ Hᵀ S⁻¹ (Bishop, eq. 17, 20)."""
        predicted, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        R = self.model.measurement_noise(t, channels)
        residual = self.model.output(channels).minus(y, predicted)
        P = belief.cov
        PHt = P @ H.mT
        c = correct(residual, symmetrize(H @ PHt + R), PHt, mask)
        if self.covariance_update == "symmetric":
            cov = P - c.reduction
        else:
            # A component that did not arrive has a zero column in K, so H and R need no mask.
            A = np.eye(P.shape[-1]) - c.gain @ H
            cov = A @ P
            if self.covariance_update == "joseph":
                cov = cov @ A.mT + c.gain @ R @ c.gain.mT
        return settle(self.model.space, belief, c.delta, symmetrize(cov), c.fault), c.innovation
