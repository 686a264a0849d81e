"""Filters that estimate sensor biases and unknown inputs along with the state (source 002)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from estbench.errors import EstimatorError, ScenarioError
from estbench.estimators import registry
from estbench.estimators.over import OverAugmented
from estbench.estimators.protocol import Estimator
from estbench.estimators.schmidt import SchmidtEKF
from estbench.estimators.settings import base, has_model, names, table
from estbench.models.augmented import Augmented
from estbench.models.protocol import Model
from estbench.shapes import Array, Float

PerName = float | Sequence[float] | dict[str, float]


@dataclass(frozen=True)
class BiasFilter(OverAugmented):
    """A Gaussian filter on the model augmented with biases; mean and cov are of the original state.

    Each quantity is a number for all, a list, or {pattern: number} over the measurement coordinates
    (`inputs`: over the controls `u0`, `u1`, ...). A coordinate without a positive std has no bias;
    without any bias the filter is the base filter. See `estbench.models.augmented.Augmented`.

    Cost per step: that of the base filter. k unknown inputs cost the EKF 2 k + 1 more transitions
    and measurements; every bias or input costs the UKF 2 more of each. Choose it where persistent
    biases are observable; tuning Q does not replace it.

    Attributes:
        model: the model without biases.
        bias: std of the biases at the start, in the measurement's unit.
        walk: random walk of the biases, unit per √s.
        time_constant: correlation time of Gauss-Markov biases, s; 0 for constants and random walks.
        inputs: std of unknown additions to the controls at the start.
        input_walk: their random walk.
        input_time_constant: correlation time of Gauss-Markov inputs, s; 0 for constants and walks.
        settings: settings of the base filter.
    """

    model: Model
    bias: PerName = 0.0
    walk: PerName = 0.0
    time_constant: PerName = 0.0
    inputs: PerName = 0.0
    input_walk: PerName = 0.0
    input_time_constant: PerName = 0.0
    settings: Mapping[str, Any] = field(default_factory=dict)
    _augmented: Augmented = field(init=False, repr=False)
    _filter: Estimator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        has_model(self)
        table(self, "settings")
        try:
            augmented = Augmented.build(
                self.model, self.bias, self.walk, self.time_constant, self.inputs,
                self.input_walk, self.input_time_constant,
            )  # fmt: skip
            filter = self._build(augmented)
        except ScenarioError as error:
            raise EstimatorError(f"{type(self).__name__}: {error}") from None
        object.__setattr__(self, "_augmented", augmented)
        object.__setattr__(self, "_filter", filter)

    def biases(self, belief: Any) -> dict[str, tuple[Float[Array, " run"], Float[Array, " run"]]]:
        """Name -> estimate and standard deviation of each bias and unknown input."""
        names = self._augmented.space.names[self.model.space.n :]
        mean = self._filter.mean(belief)[:, self.model.space.nx :]
        variance = np.diagonal(self._filter.cov(belief), axis1=-2, axis2=-1)
        std = np.sqrt(variance[:, self.model.space.n :])
        return {name: (mean[:, i], std[:, i]) for i, name in enumerate(names)}

    def _build(self, augmented: Augmented) -> Estimator:
        return registry.create("ekf", self.settings, augmented)


@dataclass(frozen=True)
class BiasEKF(BiasFilter):
    """EKF with sensor biases and unknown inputs as states, estimated or only considered.

    Attributes:
        considered: patterns of coordinates that are not estimated, e.g. `bias.*`.
    """

    considered: Sequence[str] = ()

    def _build(self, augmented: Augmented) -> Estimator:
        names(self, "considered")
        if not self.considered:
            return super()._build(augmented)
        name = f"{SchmidtEKF.__module__}:{SchmidtEKF.__name__}"
        return registry.create(name, {**self.settings, "considered": self.considered}, augmented)


@dataclass(frozen=True)
class BiasUKF(BiasFilter):
    """UKF, or another sigma-point filter, with sensor biases and unknown inputs as states.

    Attributes:
        base: the filter, one of `bases`, or your own `package.module:Name`.
    """

    base: str = "ukf"
    bases: ClassVar[tuple[str, ...]] = ("ukf", "sr_ukf", "ckf", "ghkf", "rotated_ukf")

    def _build(self, augmented: Augmented) -> Estimator:
        base(self, self.bases)
        return registry.create(self.base, self.settings, augmented)
