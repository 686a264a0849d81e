"""What an estimator shares that leaves prediction and update to a filter of its own."""

from typing import Any

from estbench.estimators.protocol import Estimator, Innovation
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask


class OverFilter:
    """Predicts and updates as its `_filter` does; a belief is that filter's."""

    _filter: Estimator

    def predict(self, belief: Any, u: Float[Array, "run nu"], t: float, dt: float) -> Any:
        """The filter's prediction."""
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
        """The filter's update."""
        return self._filter.update(belief, y, u, t, channels, mask)
