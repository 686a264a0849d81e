"""Iterated extended Kalman filter (Bell & Cathey, IEEE Trans. Automatic Control 38(2), 1993)."""

from dataclasses import dataclass, replace

import numpy as np

from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.linear import posterior_cov
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import in_range, whole
from estbench.estimators.update import apply_correction, correct
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import symmetrize


@dataclass(frozen=True)
class IEKF(EKF):
    """Iterated EKF: the update is repeated at its own result, which is Gauss-Newton for the mode.

    It minimizes |x ⊖ x̂⁻|² in P⁻ plus |y ⊖ h(x)|² in R (Bell & Cathey 1993).
    The error is written in the tangent at x̂⁻, xᵢ = x̂⁻ ⊞ δᵢ with δ₀ = 0, and the iteration is
    δᵢ₊₁ = Kᵢ (y ⊖ h(xᵢ) + Hᵢ δᵢ), Hᵢ = ∂h(x̂⁻ ⊞ δ)/∂δ at δᵢ. One iteration is the EKF.

    Cost per step: n + 1 transitions and up to `iterations` (n + 1) measurements with forward
    differences. Choose it for a precise, strongly nonlinear measurement (range and bearing at short
    distance) and a poor prior. The step is not damped: where h is not monotonic the result may be
    worse than that of the EKF.

    Attributes:
        model: the filter's model.
        covariance_update: as in `EKF`.
        iterations: maximal number of linearizations of one update.
        tolerance: a run has converged when no coordinate of δ changes by more than so many prior
            standard deviations; a converged run is not changed by further iterations.
    """

    iterations: int = 5
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        whole(self, "iterations", 1, 1000)
        in_range(self, "tolerance", 0.0)

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """x̂⁺ = x̂⁻ ⊞ δ; P⁺ from the last linearization; ν, S and NIS from the first."""
        space, output = self.model.space, self.model.output(channels)
        R = self.model.measurement_noise(t, channels)
        P = belief.cov
        scale = self.tolerance * np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1), 0.0))
        delta, cov = np.zeros(P.shape[:-1]), P
        fault, active = np.zeros(len(P), np.uint8), np.ones(len(P), bool)
        innovation, gain = None, None
        for _ in range(self.iterations):
            point = space.plus(belief.mean, delta)
            predicted, H = self.model.measurement_jacobian(point, u, t, channels)
            if not space.flat:
                H = H @ space.reset_jacobian(delta)
            residual = output.minus(y, predicted) + (H @ delta[..., None])[..., 0]
            PHt = P @ H.mT
            c = correct(residual, symmetrize(H @ PHt + R), PHt, mask)
            innovation, gain = innovation or c.innovation, c.innovation.gain
            moved = np.abs(c.delta - delta)
            rows = active[:, None]
            delta = np.where(rows, c.delta, delta)
            cov = np.where(rows[..., None], posterior_cov(self.covariance_update, P, c, H, R), cov)
            fault = np.where(active, c.fault, fault)
            active = active & (moved > scale).any(axis=-1)
            if not active.any():
                break
        assert innovation is not None
        posterior = apply_correction(space, belief, delta, symmetrize(cov), fault)
        return posterior, replace(innovation, gain=gain)
