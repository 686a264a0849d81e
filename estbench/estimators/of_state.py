"""An estimator on a model with the seen disturbance in its state, as one of the state alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from estbench.estimators.over import OverAugmented
from estbench.estimators.protocol import Estimator, FilterHistory, Smoother
from estbench.models.seen_noise import SeenNoise


@dataclass(frozen=True)
class OfState(OverAugmented):
    """Any estimator on a `SeenNoise` model; mean and cov are of the state without disturbances.

    The belief is that of the estimator, so it costs nothing more.

    Attributes:
        estimator: built on the model with the disturbance in its state.
        augmented: that model.
    """

    estimator: Estimator
    augmented: SeenNoise
    _filter: Estimator = field(init=False, repr=False)
    _augmented: SeenNoise = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_filter", self.estimator)
        object.__setattr__(self, "_augmented", self.augmented)

    @classmethod
    def of(cls, estimator: Estimator, augmented: SeenNoise) -> "OfState":
        """One that smooths too, if the estimator does."""
        return (SmootherOfState if hasattr(estimator, "smooth") else cls)(estimator, augmented)


@dataclass(frozen=True)
class SmootherOfState(OfState):
    """The same of a smoother."""

    def smooth(self, history: FilterHistory) -> Sequence[Any]:
        """The smoothed beliefs of the estimator."""
        return cast(Smoother, self.estimator).smooth(history)
