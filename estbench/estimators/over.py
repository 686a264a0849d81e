"""Base of the estimators that delegate prediction and update to another filter."""

from typing import Any

from estbench.estimators.protocol import Estimator, Innovation, depends_on_time
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask


class OverFilter:
    """Delegates prediction and update to `_filter`; the belief is that of this filter."""

    _filter: Estimator

    @property
    def depends_on_time(self) -> bool:
        """Whether the filter is a `TimeDependent` one."""
        return depends_on_time(self._filter)

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
