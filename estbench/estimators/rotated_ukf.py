"""Randomly rotated unscented Kalman filter (after Straka, Duník & Šimandl 2012, 2013)."""

from dataclasses import dataclass, replace

import numpy as np

from estbench.estimators.beliefs import Gaussian, random_start
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import below, has_model, in_range, switch, whole
from estbench.estimators.sigma_points import SigmaPoints, symmetric
from estbench.estimators.ukf import SigmaBelief, SigmaPointFilter
from estbench.randomness.orthogonal import haar
from estbench.shapes import Array, Float, Keys, UInt


@dataclass(frozen=True, eq=False, kw_only=True)
class RotatedBelief(SigmaBelief):
    """A Gaussian and the state of its random numbers.

    Attributes:
        keys: keys of the random numbers of each run.
        counter: number of predictions and of measurements that arrived.
    """

    keys: UInt[Keys, " run"]
    counter: UInt[Keys, " run"]


@dataclass(frozen=True)
class RotatedUKF(SigmaPointFilter):
    """UKF whose points x̂ ⊞ L U ξᵢ are rotated at random in each prediction and update.

    U is uniform over the orthogonal matrices, another one in each run, and the ξᵢ are the centre
    and ± sqrt(n/(1 - w₀)) eⱼ. A rule with fixed axes misses what happens between them, and in the
    same directions in each step; the errors of rotated axes average out over the steps. The
    covariance Ω of the linearization error is counted once more, P⁻ = Σ wᵢ rᵢ rᵢᵀ + ω Ω + Q and
    the same in S. This is a heuristic that stands in for more rotations per step: with K rotations
    Ω is known better and ω may be smaller. On a linear model Ω = 0, and the filter is the Kalman
    filter.

    The rotated third-degree rule is that of the randomized UKF (Straka, Duník & Šimandl, FUSION
    2012) and of the stochastic integration filter (Duník, Straka & Šimandl, IEEE Trans. Automatic
    Control 58(6), 2013), which also draw the radius and average many rotations. Here the radius is
    fixed, all weights are positive for 0 <= w₀ < 1, and few rotations suffice. Ω is the error of
    the statistical linear regression (Lefebvre, Bruyninckx & De Schutter 2002; García-Fernández et
    al. 2015).

    Cost per step: 2 n K + 1 transitions and measurements, one less of each with w₀ = 0. Choose it
    for robots in contact, where the UKF is overconfident; on a smooth model it equals the UKF up to
    the error of the quadrature.

    Attributes:
        model: the filter's model.
        redraw: as in `SigmaPointFilter`; points that are not redrawn count no Ω in S.
        omega: ω, at least 0.
        centre_weight: w₀, below 1; a negative one lets P lose its definiteness.
        rotations: K, rotations in each prediction and update.
    """

    omega: float = 1.0
    centre_weight: float = 0.25
    rotations: int = 1

    def __post_init__(self) -> None:
        has_model(self)
        switch(self, "redraw")
        in_range(self, "omega", 0.0)
        below(self, "centre_weight", 1.0)
        whole(self, "rotations", 1, 1000)
        axes = np.eye(self.model.space.n)[None]
        object.__setattr__(self, "rule", symmetric(axes, self.centre_weight))

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> RotatedBelief:
        """Start from N(mean, cov); `keys`, one per run, default to 0, 1, ..."""
        start = super().init(mean, cov)
        keys, counter = random_start(len(mean), keys)
        return RotatedBelief(start.mean, start.cov, start.fault, keys=keys, counter=counter)

    def rule_at(self, belief: RotatedBelief, purpose: int) -> SigmaPoints:
        """The rotated points of each run; the same for the same belief."""
        n = self.model.space.n
        axes = haar(belief.keys, belief.counter, purpose, self.rotations, n)
        return symmetric(axes, self.centre_weight)

    def drawn(self, belief: RotatedBelief, innovation: Innovation | None = None) -> Gaussian:
        """Counts, in the runs where something arrived."""
        arrived = np.uint64(1) if innovation is None else (innovation.dof > 0).astype(np.uint64)
        return replace(belief, counter=belief.counter + arrived)
