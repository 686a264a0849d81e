"""Iterated posterior linearization filter (García-Fernández et al. 2015)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from estbench.errors import EstimatorError
from estbench.estimators import registry
from estbench.estimators.over import OverFilter
from estbench.estimators.posterior_linearization import Measured, Whitened, condition
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import in_range, one_of, table, whole
from estbench.estimators.sigma_points import SigmaPoints
from estbench.estimators.ukf import MEASUREMENT, SigmaPointFilter, failed_factor
from estbench.estimators.update import apply_correction
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Faults, Float, Mask, UInt
from estbench.spaces.linalg import symmetrize
from estbench.spaces.semidefinite import psd_root


@dataclass(frozen=True)
class IPLF(OverFilter):
    """Iterated posterior linearization filter: h is linearized about the posterior itself.

    The update of a sigma-point filter linearizes h about the prior. If the measurement is precise,
    the prior is much wider than the posterior, and the linearization fits where the state is not.
    Here it is repeated about each posterior found, as the IEKF repeats the derivative. See
    `estbench.estimators.posterior_linearization.condition`. One iteration is the base filter.

    Cost per step: the base filter's transitions, and its measurements up to `iterations` times.
    Choose it for precise, strongly nonlinear measurements, where it is more accurate than the IEKF
    and knows its linearization error. It is not damped.

    Attributes:
        model: the filter's model.
        base: the filter that predicts and whose points are used, one of `bases`.
        settings: of the base filter.
        iterations: maximal number of linearizations of one update.
        tolerance: a run has converged when the mean, in whitened coordinates of the prior, changes
            by no more; a converged run is not changed by further iterations.
    """

    model: Model
    base: str = "ukf"
    settings: Mapping[str, Any] = field(default_factory=dict)
    iterations: int = 5
    tolerance: float = 1e-3
    bases: ClassVar[tuple[str, ...]] = ("ukf", "ckf", "ghkf", "rotated_ukf")
    _filter: SigmaPointFilter = field(init=False, repr=False)

    def __post_init__(self) -> None:
        one_of(self, "base", self.bases)
        table(self, "settings")
        whole(self, "iterations", 1, 1000)
        in_range(self, "tolerance", 0.0)
        filter = registry.create(self.base, self.settings, self.model)
        assert isinstance(filter, SigmaPointFilter)
        if not filter.redraw:
            raise EstimatorError(
                f"{type(self).__name__}: redraw is false; leave it out of the settings, each "
                "linearization has points of its own"
            )
        object.__setattr__(self, "_filter", filter)

    def update(
        self,
        belief: Any,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Any, Innovation]:
        """x̂⁺ = x̂⁻ ⊞ L η, P⁺ = L C Lᵀ; ν, S and NIS from the first linearization."""
        root = psd_root(belief.cov)
        rule = self.rule_at(belief, MEASUREMENT)
        how = rule, self.omega, self.iterations, self.tolerance
        found = condition(self.model, belief.mean, root, Measured(y, u, t, channels, mask, *how))
        lost = failed_factor(root, belief.cov)
        return self._posterior(belief, root, found, lost), found.innovation

    @property
    def omega(self) -> float:
        """How often the base filter counts Ω beyond once."""
        return self._filter.omega

    def rule_at(self, belief: Any, purpose: int) -> SigmaPoints:
        """The sigma points of the base filter for one belief and PREDICTION or MEASUREMENT."""
        return self._filter.rule_at(belief, purpose)

    def mean(self, belief: Any) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return belief.mean

    def cov(self, belief: Any) -> Float[Array, "run n n"]:
        """The covariance P."""
        return belief.cov

    def _posterior(
        self, prior: Any, root: Array, found: Whitened, lost: UInt[Faults, " run"]
    ) -> Any:
        """From whitened coordinates to the state."""
        delta = (root @ found.mean[..., None])[..., 0]
        cov = symmetrize(root @ found.cov @ root.mT)
        fault = np.where(lost, lost, found.fault)
        posterior = apply_correction(self.model.space, prior, delta, cov, fault)
        return self._filter.drawn(posterior, found.innovation)
