"""What an estimator shares that leaves prediction and update to a filter of its own."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.estimators.protocol import Estimator, Innovation
from estbench.models.protocol import Channels
from estbench.shapes import Array


class OverFilter:
    """Predicts and updates as its `_filter` does; a belief is that filter's."""

    _filter: Estimator

    def predict(self, belief: Any, u: Array, t: float, dt: float) -> Any:
        """The filter's prediction."""
        return self._filter.predict(belief, u, t, dt)

    def update(
        self,
        belief: Any,
        y: Array,
        u: Array,
        t: float,
        channels: Channels = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> tuple[Any, Innovation]:
        """The filter's update."""
        return self._filter.update(belief, y, u, t, channels, mask)
