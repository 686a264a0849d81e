"""Base of the estimators that delegate prediction and update to another filter."""

from typing import Any, Protocol

from estbench.estimators.beliefs import start
from estbench.estimators.protocol import Estimator, Innovation, depends_on_time
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Keys, Mask, UInt


class OverFilter:
    """Delegates prediction and update to `_filter`; the belief is that of this filter."""

    _filter: Estimator

    @property
    def depends_on_time(self) -> bool:
        """Whether the filter is a `TimeDependent` one."""
        return depends_on_time(self._filter)

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> Any:
        """The start of the filter; `keys` are for one that draws random numbers."""
        return start(self._filter, mean, cov, keys)

    def predict(self, belief: Any, u: Float[Array, "run nu"], t: float, dt: float) -> Any:
        """The prediction of the filter."""
        return self._filter.predict(belief, u, t, dt)

    def update(
        self,
        belief: Any,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Any, Innovation]:
        """The update of the filter."""
        return self._filter.update(belief, y, u, t, channels, mask)


class Augmentation(Protocol):
    """A model with further states."""

    @property
    def model(self) -> Model:
        """The model without them."""
        ...

    def augment(
        self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
    ) -> tuple[Float[Array, "run nx_augmented"], Float[Array, "run n_augmented n_augmented"]]:
        """x̂₀ and P₀ with the further states."""
        ...


class OverAugmented(OverFilter):
    """Delegates to a filter on a model with further states; mean and cov are of the state alone."""

    _augmented: Augmentation

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> Any:
        """Start from N(mean, cov); `keys` are for a filter that draws random numbers."""
        return super().init(*self._augmented.augment(mean, cov), keys)

    def mean(self, belief: Any) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return self._filter.mean(belief)[:, : self._augmented.model.space.nx]

    def cov(self, belief: Any) -> Float[Array, "run n n"]:
        """The covariance P."""
        n = self._augmented.model.space.n
        return self._filter.cov(belief)[:, :n, :n]
