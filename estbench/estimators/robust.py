"""EKF for measurements with outliers: gates, Huber's loss, or Student-t measurement noise."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.linear import linear_update, without_absent
from estbench.estimators.no_return import returned
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import in_range, one_of, whole
from estbench.estimators.update import correct, mark_failed
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import cholesky, solve_lower, symmetrize


@dataclass(frozen=True)
class RobustEKF(EKF):
    """Robust EKF: an outlier has little or no effect on the update (gates, Huber, Student-t).

    Cost per step: the evaluations of the EKF; the iterations involve small matrices only. Choose it
    where readings have outliers. Gates are for gross errors, but a filter that has diverged rejects
    every reading. `huber` bounds the influence of a reading. `student_t` is for noise with heavy
    tails. The innovation is the one before gating or reweighting, so that NIS shows the outliers.

    Attributes:
        model: the filter's model.
        covariance_update: `joseph` only.
        method: `gate_components` rejects a component when ν²/S exceeds the chi-square quantile,
            `gate` the whole measurement when NIS does (Bar-Shalom, Li & Kirubarajan 2001);
            `huber` minimizes the prior's square and Huber's loss of the measurement's
            whitened residuals (Huber 1964; Karlgaard & Schaub 2007), by reweighting; `student_t` is
            variational Bayes with one random scale of R per measurement (Piché, Särkkä &
            Hartikainen 2012).
        gate: probability that a good measurement passes the gate.
        threshold: where Huber's loss turns from square to linear, in standard deviations of R.
        degrees: degrees of freedom of Student's t, whose scale matrix R is.
        iterations: number of reweightings.
    """

    method: Literal["gate_components", "gate", "huber", "student_t"] = "gate_components"
    gate: float = 0.999
    threshold: float = 1.345
    degrees: float = 4.0
    iterations: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "covariance_update", ("joseph",))
        one_of(self, "method", ("gate_components", "gate", "huber", "student_t"))
        in_range(self, "gate", 0.0, 1.0, low_open=True)
        in_range(self, "threshold", 0.0, low_open=True)
        in_range(self, "degrees", 0.0, low_open=True)
        whole(self, "iterations", 1, 1000)

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """The EKF's update with gated components, or with R enlarged for large residuals."""
        space, output = self.model.space, self.model.output(channels)
        predicted, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        residual = output.minus(y, predicted)
        m, mask = output.n, returned(residual, mask)
        R = np.broadcast_to(self.model.measurement_noise(t, channels), (len(y), m, m))
        residual, H, R = without_absent(residual, H, R, mask)
        PHt = belief.cov @ H.mT
        spread = symmetrize(H @ PHt)
        first = correct(residual, spread + R, PHt, mask)
        raw, belief = first.innovation, mark_failed(belief, first.fault)
        if self.method.startswith("gate"):
            passed = self._passed(raw)
            refused = ~passed if mask is None else mask & ~passed
            raw = replace(raw, gated=np.count_nonzero(refused, axis=-1))
            mask = passed if mask is None else mask & passed
        else:
            R = self._enlarged(R, residual, spread, raw.dof)
        posterior, used = linear_update(space, belief, residual, H, R, mask)
        return posterior, replace(raw, gain=used.gain)

    def _passed(self, innovation: Innovation) -> NDArray[np.bool_]:
        """Mask of the components within the gate; those of a failed run are in the mask."""
        if self.method == "gate":
            limit = chdtri(np.maximum(innovation.dof, 1), 1.0 - self.gate)
            out = np.broadcast_to(~(innovation.nis > limit)[:, None], innovation.residual.shape)
            return np.asarray(out)
        variance = np.diagonal(innovation.cov, axis1=-2, axis2=-1)
        return ~(innovation.residual**2 > chdtri(1, 1.0 - self.gate) * variance)

    def _enlarged(self, R: Array, residual: Array, spread: Array, dof: NDArray[np.int64]) -> Array:
        """R `(run, m, m)` divided by the weights at the fixed point of the reweighting.

        In the measurement's space: after an update with R̃ and S̃ = H P Hᵀ + R̃ the residual is
        R̃ S̃⁻¹ ν and the spread of H x is R̃ - R̃ S̃⁻¹ R̃.
        """
        root = cholesky(R)
        enlarged = R
        for _ in range(self.iterations):
            lower = cholesky(symmetrize(spread + enlarged))
            joint = np.concatenate([residual[..., None], enlarged], axis=-1)
            joint = solve_lower(lower, joint)
            half = joint[..., 1:].mT  # R̃ L⁻ᵀ
            left = (half @ joint[..., :1])[..., 0]
            white = solve_lower(root, left[..., None])[..., 0]
            if self.method == "huber":
                size = np.abs(white)
                scale = np.where(size > self.threshold, size / self.threshold, 1.0)
            else:
                after = enlarged - half @ half.mT
                after = solve_lower(root, np.swapaxes(solve_lower(root, after), -1, -2))
                square = (white**2).sum(axis=-1) + np.trace(after, axis1=-2, axis2=-1)
                scale = ((self.degrees + square) / (self.degrees + dof))[:, None]
            factor = root * np.sqrt(scale)[:, None]
            enlarged = factor @ factor.mT
        return enlarged
