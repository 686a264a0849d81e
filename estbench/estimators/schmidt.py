"""Schmidt-Kalman (consider) filter on an extended model (Jazwinski 1970, ch. 8)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.linear import joseph
from estbench.estimators.protocol import Gain, Innovation
from estbench.estimators.settings import names, one_of
from estbench.estimators.update import apply_correction, correct
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import symmetrize
from estbench.spaces.patterns import expand


@dataclass(frozen=True)
class SchmidtEKF(EKF):
    """Schmidt-Kalman EKF: considered coordinates are uncertain, but not estimated (gain zero).

    The rows of the optimal gain K = P⁻ Hᵀ S⁻¹ for the considered coordinates are set to zero. The
    covariance is updated in Joseph's form, which holds for any gain: the considered coordinates
    keep their variance, and their correlations with the other coordinates are correct.

    Cost per step: that of the EKF. Choose it for biases and parameters that are too weakly
    observable to estimate but too large to ignore; usually on an `Augmented` model, whose biases
    are called `bias.*` and `input.*` (from a scenario: `type = "bias_ekf"` with `considered`).

    Attributes:
        model: the filter's model.
        covariance_update: `joseph` only.
        considered: patterns of the state coordinates that are not estimated; none makes it the EKF.

    Raises:
        ScenarioError: a pattern matches no coordinate.
    """

    considered: Sequence[str] = ()
    _estimated: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "covariance_update", ("joseph",))
        names(self, "considered")
        patterns = dict.fromkeys(self.considered, 0.0)
        what = f"{type(self).__name__}: considered"
        estimated = expand(patterns, self.model.space.names, what, default=1.0)
        object.__setattr__(self, "_estimated", estimated)

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """x̂⁺ = x̂⁻ ⊞ K ν and P⁺ in Joseph's form, with the considered rows of K at zero."""
        predicted, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        R = self.model.measurement_noise(t, channels)
        residual = self.model.output(channels).minus(y, predicted)
        PHt = belief.cov @ H.mT
        c = correct(residual, symmetrize(H @ PHt + R), PHt, mask)
        K = c.gain * self._estimated[:, None]
        cov = joseph(belief.cov, K, H, R)
        delta = c.delta * self._estimated
        gain = Gain(c.white.mT * self._estimated[:, None], cast(Array, c.innovation.factor))
        posterior = apply_correction(self.model.space, belief, delta, symmetrize(cov), c.fault)
        return posterior, replace(c.innovation, gain=gain)
