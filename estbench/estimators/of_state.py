"""An estimator on a model with the seen disturbance in its state, as one of the state alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from estbench.estimators.beliefs import start
from estbench.estimators.over import OverFilter
from estbench.estimators.protocol import Estimator, FilterHistory, Smoother
from estbench.models.seen_noise import SeenNoise
from estbench.shapes import Array, Float, Keys, UInt


@dataclass(frozen=True)
class OfState(OverFilter):
    """Any estimator on a `SeenNoise` model; mean and cov are of the state without disturbances.

    The belief is that of the estimator, so it costs nothing more.

    Attributes:
        estimator: built on the model with the disturbance in its state.
        augmented: that model.
    """

    estimator: Estimator
    augmented: SeenNoise
    _filter: Estimator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_filter", self.estimator)

    @classmethod
    def of(cls, estimator: Estimator, augmented: SeenNoise) -> "OfState":
        """One that smooths too, if the estimator does."""
        return (SmootherOfState if hasattr(estimator, "smooth") else cls)(estimator, augmented)

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> Any:
        """Start from N(mean, cov); `keys` are for an estimator that draws random numbers."""
        return start(self.estimator, *self.augmented.augment(mean, cov), keys)

    def mean(self, belief: Any) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return self.estimator.mean(belief)[:, : self.augmented.model.space.nx]

    def cov(self, belief: Any) -> Float[Array, "run n n"]:
        """The covariance P."""
        n = self.augmented.model.space.n
        return self.estimator.cov(belief)[:, :n, :n]


@dataclass(frozen=True)
class SmootherOfState(OfState):
    """The same of a smoother."""

    def smooth(self, history: FilterHistory) -> Sequence[Any]:
        """The smoothed beliefs of the estimator."""
        return cast(Smoother, self.estimator).smooth(history)
