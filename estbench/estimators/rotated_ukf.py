"""Randomly rotated unscented Kalman filter (after Straka, Duník & Šimandl 2012, 2013)."""

from dataclasses import dataclass, field, replace

import numpy as np

from estbench.errors import EstimatorError, ScenarioError
from estbench.estimators.beliefs import Gaussian, random_start
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import below, has_model, in_range, switch, whole
from estbench.estimators.sigma_points import SigmaPoints, symmetric
from estbench.estimators.ukf import SigmaBelief, SigmaPointFilter
from estbench.models.symmetric import Symmetries
from estbench.randomness.orthogonal import haar
from estbench.shapes import Array, Float, Keys, UInt
from estbench.spaces.linalg import solve_lower
from estbench.spaces.semidefinite import psd_root


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
        symmetries: whether the points along the symmetries of the transition keep axes of their
            own, L⁻¹ N for their directions N (`models.symmetric`): for a robot on level ground
            without a fix of position and heading. Points that mix them with coordinates at a
            contact correlate both by chance, so that readings of the one seem to show the other.
            Where P is singular the first axes are kept instead.

    Raises:
        EstimatorError: `symmetries` for a model that has none.
    """

    omega: float = 1.0
    centre_weight: float = 0.25
    rotations: int = 1
    symmetries: bool = False
    _kept: Symmetries | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        has_model(self)
        switch(self, "redraw")
        switch(self, "symmetries")
        in_range(self, "omega", 0.0)
        below(self, "centre_weight", 1.0)
        whole(self, "rotations", 1, 1000)
        axes = np.eye(self.model.space.n)[None]
        object.__setattr__(self, "rule", symmetric(axes, self.centre_weight))
        if self.symmetries:
            object.__setattr__(self, "_kept", self._found())

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
        n, kept = self.model.space.n, self._kept
        turned = n if kept is None else n - kept.count
        axes = haar(belief.keys, belief.counter, purpose, self.rotations, turned)
        if kept is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                own = solve_lower(psd_root(belief.cov), kept(belief.mean))
            own = np.where(np.isfinite(own).all(axis=(-2, -1), keepdims=True), own, 0.0)
            basis = np.linalg.qr(own, mode="complete")[0].mT[:, None]
            rest = axes @ basis[:, :, kept.count :]
            own = np.broadcast_to(basis[:, :, : kept.count], (*rest.shape[:2], kept.count, n))
            axes = np.concatenate([rest, own], axis=-2)
        return symmetric(axes, self.centre_weight)

    def drawn(self, belief: RotatedBelief, innovation: Innovation | None = None) -> Gaussian:
        """Counts, in the runs where something arrived."""
        arrived = np.uint64(1) if innovation is None else (innovation.dof > 0).astype(np.uint64)
        return replace(belief, counter=belief.counter + arrived)

    def _found(self) -> Symmetries:
        """The symmetries of the model."""
        name = type(self).__name__
        try:
            found = getattr(self.model, "symmetries", None)
        except ScenarioError as error:
            raise EstimatorError(f"{name}: symmetries is true, but {error}") from None
        if found is None:
            raise EstimatorError(
                f"{name}: symmetries is true, but the model has none; leave the setting out"
            )
        return found
