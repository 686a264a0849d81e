"""Innovations as they were, for a store that keeps everything: an estimator that is listened to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from estbench.estimators.base import Estimator, Innovation, Passage
from estbench.manifold import Manifold
from estbench.models.base import Channels

Array = NDArray[np.float64]


def readings(spaces: Mapping[str, Manifold]) -> tuple[str, ...]:
    """Name of each component of the measurement `(m,)`: the channel's, with the coordinate's."""
    return tuple(
        channel if space.n == 1 else f"{channel}.{name}"
        for channel, space in spaces.items()
        for name in space.names
    )


def listen(
    estimator: Estimator, spaces: Mapping[str, Manifold], ends: Sequence[float], runs: int
) -> "Listened":
    """The estimator, with its innovations noted as it updates.

    Args:
        estimator: any object of the protocol.
        spaces: channel -> the manifold of its readings, in the measurement's order.
        ends: time of each instant `(K,)`, s.
        runs: how many.
    """
    # A class of the same name: error messages name the user's class, not this one.
    base = ListenedSmoother if hasattr(estimator, "smooth") else Listened
    kind = cast(type[Listened], type(type(estimator).__name__, (base,), {}))
    return kind(estimator, spaces, ends, runs)


@dataclass(frozen=True, eq=False)
class Heard:
    """A belief in a wrapper: who drives the estimator sees nothing that it could cut into runs.

    An update of some of the runs would not say which ones they are.
    """

    belief: Any

    @property
    def fault(self) -> Any:
        """Why runs failed, where the belief says it."""
        return getattr(self.belief, "fault", None)


class Listened:
    """See `listen`.

    Attributes:
        innovation: ν of each instant `(K + 1, run, m)`, NaN where nothing was fused; index 0 is
            the prior. Of two readings of one component at an instant the last counts, and a
            replay writes over what it changes.
        innovation_cov: S of the components fused together `(K + 1, run, m, m)`.
    """

    def __init__(
        self,
        estimator: Estimator,
        spaces: Mapping[str, Manifold],
        ends: Sequence[float],
        runs: int,
    ):
        stops = np.cumsum([0, *(space.n for space in spaces.values())])
        self._estimator = estimator
        self._places = {name: np.arange(a, b) for name, a, b in zip(spaces, stops, stops[1:])}
        self._index = {t: k + 1 for k, t in enumerate(ends)}
        self.innovation = np.full((len(ends) + 1, runs, stops[-1]), np.nan)
        self.innovation_cov = np.full((len(ends) + 1, runs, stops[-1], stops[-1]), np.nan)

        @wraps(estimator.init)  # its signature says whether it takes random keys
        def init(*arguments: Any, **keys: Any) -> Heard:
            return Heard(estimator.init(*arguments, **keys))

        self.init = init

    def predict(self, belief: Heard, u: Array, t: float, dt: float) -> Heard:
        """The estimator's own prediction."""
        return Heard(self._estimator.predict(belief.belief, u, t, dt))

    def mean(self, belief: Heard) -> Array:
        """x̂ `(run, nx)`."""
        return self._estimator.mean(belief.belief)

    def cov(self, belief: Heard) -> Array:
        """P `(run, n, n)`."""
        return self._estimator.cov(belief.belief)

    def update(
        self,
        belief: Heard,
        y: Array,
        u: Array,
        t: float,
        channels: Channels = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> tuple[Heard, Innovation]:
        """The estimator's own update."""
        masked = {} if mask is None else {"mask": mask}
        after, innovation = self._estimator.update(belief.belief, y, u, t, channels, **masked)
        where = np.concatenate([self._places[name] for name in channels or self._places])
        if np.shape(innovation.residual)[-1:] == where.shape:  # a particle filter may give none
            fused = innovation.dof[:, None] > 0  # a start that only gathers readings fuses none
            came = np.broadcast_to(
                fused if mask is None else mask & fused, innovation.residual.shape
            )
            both = came[:, :, None] & came[:, None, :]
            residual, cov = self.innovation[self._index[t]], self.innovation_cov[self._index[t]]
            block = np.ix_(np.arange(len(cov)), where, where)
            residual[:, where] = np.where(came, innovation.residual, residual[:, where])
            cov[block] = np.where(both, innovation.cov, cov[block])
        return Heard(after), innovation


class ListenedSmoother(Listened):
    """One that also looks back."""

    def smooth(self, passage: Passage) -> list[Heard]:
        """The estimator's own look back."""
        inner = replace(passage, beliefs=[belief.belief for belief in passage.beliefs])
        return [Heard(belief) for belief in self._estimator.smooth(inner)]  # type: ignore[attr-defined]
