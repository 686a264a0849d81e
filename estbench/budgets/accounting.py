"""A filter with an account of its error: as it predicts and updates, so does the spread."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.budgets.recursion import Interval, Reading, Spread, predicted, updated
from estbench.errors import EstimatorError
from estbench.estimators.protocol import Estimator, Gain, Innovation
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Faults, Float, Mask


@dataclass(frozen=True, eq=False)
class Account:
    """A belief and the spread of its error."""

    belief: Any
    spread: Spread

    @property
    def fault(self) -> Faults:
        """Of the belief."""
        return self.belief.fault


@dataclass(frozen=True, eq=False)
class Accounting:
    """An estimator whose belief carries the spread of its error, by its own gains.

    It has the methods of an estimator, so that the event loop goes back for late readings with the
    spread as with the belief.

    Attributes:
        estimator: any that shows its gain.
        start: the spread at the start.
        interval: (start of a prediction, s) -> its terms.
        reading: (time, channels, when its components were taken) -> the terms of an update.
        taken: of the updates to come, from `Stamps`; None where all are fused when taken.
    """

    estimator: Estimator
    start: Spread
    interval: Callable[[float], Interval]
    reading: Callable[[float, Channels, Array | None], Reading]
    taken: "Stamps | None" = None

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> Account:
        """The start."""
        return Account(self.estimator.init(mean, cov), self.start)

    def predict(self, belief: Account, u: Float[Array, "run nu"], t: float, dt: float) -> Account:
        """The prediction of both."""
        return Account(
            self.estimator.predict(belief.belief, u, t, dt),
            predicted(belief.spread, self.interval(t)),
        )

    def update(
        self,
        belief: Account,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Account, Innovation]:
        """The update of both, the spread's with the gain of the estimator.

        Raises:
            EstimatorError: the estimator shows no gain, or one of another state.
        """
        taken = None if self.taken is None else self.taken.next()
        posterior, innovation = self.estimator.update(belief.belief, y, u, t, channels, mask)
        K = gain(innovation)
        if K is None or K.shape[-2] != belief.spread.fixed.shape[-2]:
            raise EstimatorError(
                f"{type(self.estimator).__name__} shows no gain on the readings, without which "
                "there is no linear budget; use --monte-carlo"
            )
        spread = updated(belief.spread, K, self.reading(t, channels, taken))
        return Account(posterior, spread), innovation

    def mean(self, belief: Account) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return self.estimator.mean(belief.belief)

    def cov(self, belief: Account) -> Float[Array, "run n n"]:
        """The covariance that the filter believes."""
        return self.estimator.cov(belief.belief)


class Stamps:
    """An estimator that computes nothing and notes its readings, which are times of sampling.

    Driven through the same events as the filter, one step ahead, it says when each component of
    the filter's next update was taken.
    """

    def __init__(self, runs: int):
        self._runs = runs
        self._noted: deque[Array] = deque()

    def next(self) -> Float[Array, "run ny"]:
        """The readings of the next update."""
        return self._noted.popleft()

    def init(self, mean: Array, cov: Array) -> Array:
        """A belief of nothing."""
        return np.zeros(self._runs)

    def predict(self, belief: Array, u: Array, t: float, dt: float) -> Array:
        """The same."""
        return belief

    def update(
        self,
        belief: Array,
        y: Array,
        u: Array,
        t: float,
        channels: Channels = None,
        mask: Mask | None = None,
    ) -> tuple[Array, Innovation]:
        """The same, and the readings are noted."""
        self._noted.append(y)
        none, zero = np.zeros((self._runs, 0)), np.zeros(self._runs)
        return belief, Innovation(none, none[..., None], none, zero, zero.astype(np.int64))

    def mean(self, belief: Array) -> Array:
        """Nothing."""
        return belief[:, None]

    def cov(self, belief: Array) -> Array:
        """Nothing."""
        return belief[:, None, None]


def gain(innovation: Innovation) -> Float[Array, "run n m"] | None:
    """The gain that an estimator shows, of this package or of a user; None if it shows none."""
    shown = getattr(innovation, "gain", None)
    return shown.matrix if isinstance(shown, Gain) else shown
