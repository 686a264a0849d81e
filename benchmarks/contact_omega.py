"""Other uses of Ω in the prediction of `rotated_ukf`, tried and not taken: docs/contact.md.

One rotation of 2 n points knows Ω, the covariance of the linearization error, with a sampling
error. A shrunk or an averaged Ω has a smaller one, so that ω might be smaller; a concentrated ω Ω
adds only what few pairs of points know.
"""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from estbench.estimators.rotated_ukf import RotatedBelief, RotatedUKF
from estbench.estimators.sigma_points import SigmaPoints
from estbench.estimators.ukf import PREDICTION, failed_factor
from estbench.estimators.update import mark_failed
from estbench.shapes import Array, Float, Keys, UInt
from estbench.spaces.linalg import symmetrize
from estbench.spaces.semidefinite import psd_root


@dataclass(frozen=True, eq=False, kw_only=True)
class AveragedBelief(RotatedBelief):
    """The mean of Ω over the last predictions; None before the first."""

    error: Float[Array, "run n n"] | None = None


@dataclass(frozen=True)
class OmegaUKF(RotatedUKF):
    """P⁻ = A Aᵀ + Ω' + ω Ω̄ + Q, with Ω' shrunk to the diagonal of Ω and Ω̄ its running mean.

    Ω' = (1 - λ) Ω + λ diag Ω and Ω̄ₖ = (1 - ρ) Ω̄ₖ₋₁ + ρ Ω'ₖ.

    Attributes:
        shrinkage: λ, in [0, 1] (Ledoit & Wolf, J. Multivariate Analysis 88(2), 2004).
        rate: ρ, in (0, 1]; 1 keeps no past.
        concentrated: whether ω Ω is multiplied by `concentration`, element by element.
    """

    shrinkage: float = 0.0
    rate: float = 1.0
    concentrated: bool = False

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> AveragedBelief:
        """Start from N(mean, cov)."""
        start = super().init(mean, cov, keys)
        return AveragedBelief(
            start.mean, start.cov, start.fault, keys=start.keys, counter=start.counter
        )

    def predict(
        self, belief: AveragedBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> AveragedBelief:
        """x̂⁻ of `rotated_ukf`, and P⁻ as above."""
        factor, rule = psd_root(belief.cov), self.rule_at(belief, PREDICTION)
        points = rule.draw(self.model.space, belief.mean, factor)
        points = self.model.transition(points, u, t, dt)
        mean, residual, cov = rule.moments(self.model.space, points)
        noise = self.model.process_noise(belief.mean, u, t, dt)
        error = rule.regress(residual, cov)[1]
        shrunk = error + self.shrinkage * (error * np.eye(error.shape[-1]) - error)
        past = shrunk if belief.error is None else belief.error
        kept = past + self.rate * (shrunk - past)
        if self.concentrated:
            kept = kept * concentration(rule, residual, error)
        cov = symmetrize(cov - error + shrunk + noise + self.omega * kept)
        prior = replace(belief, mean=mean, cov=cov, error=kept)
        prior = cast(AveragedBelief, mark_failed(prior, failed_factor(factor, belief.cov)))
        return cast(AveragedBelief, self.drawn(prior))


def concentration(
    rule: SigmaPoints, residual: Float[Array, "run point n"], error: Float[Array, "run n n"]
) -> Float[Array, "run n n"]:
    """√(Vⱼ Vₖ), Vⱼ = Σᵢ qᵢⱼ² / (Σᵢ qᵢⱼ)² with qᵢⱼ what pair i gives to Ωⱼⱼ: 1 where it is one pair.

    1/Vⱼ is the count of pairs that know Ωⱼⱼ, and Vⱼ about the relative variance of its error.
    """
    slope = rule.regress(residual, error)[0]
    q = rule.cov_weights[:, None] * (residual - rule.points @ slope.mT) ** 2
    centre, plus, minus = np.split(q, [1, 1 + q.shape[1] // 2], axis=1)
    q = np.concatenate([centre, plus + minus], axis=1)
    total = q.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(np.where(total > 0, (q**2).sum(axis=1) / total**2, 0.0))
    return root[:, :, None] * root[:, None, :]
