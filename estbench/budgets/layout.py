"""Where each source of error is in a `Spread`: its columns of `fixed`, or its place in `moving`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estbench.bounds.sensor_errors import SensorError, errors
from estbench.budgets.sources import CONDITIONS, NONLINEAR, Source
from estbench.experiment.prepared import Setup
from estbench.sensors.channel import Channel
from estbench.shapes import Array, Float
from estbench.spaces.semidefinite import psd_root

WHITE = ("process", "noise", "outliers", "quantization", "walk", "drift")
"""Kinds that are driven by white noise."""
CONSTANT = ("bias", "scale_factor", "misalignment")
"""Kinds of sensor errors that are constant in each run."""
GIVEN = ("offset", "timing", "parameter", "model")
"""Kinds that are the same in every run of the same truth: they are no random numbers."""
REST = Source("model.rest", "model", "model")
"""What several wrong parameters do together."""


@dataclass(frozen=True, eq=False)
class Layout:
    """The places of the sources.

    Attributes:
        sources: those that a linear analysis knows.
        owner: the source of each column.
        white: those in `moving`, in order.
        errors: (place in `sources`) -> the errors of sensors.
        width: w, the components of an error that drifts.
    """

    sources: tuple[Source, ...]
    owner: NDArray[np.intp]
    white: tuple[int, ...]
    errors: dict[int, SensorError]
    width: int

    @classmethod
    def of(cls, setup: Setup, found: Sequence[Source], rest: bool) -> "Layout":
        """The places of the sources of a scenario.

        Args:
            setup: the experiment.
            found: its sources.
            rest: whether there is a further one, `REST`.
        """
        known = [s for s in found if s.kind not in (*CONDITIONS, *NONLINEAR)]
        if rest and not any(s.kind == "model" for s in known):
            known.append(REST)
        channels = {c.name: c for c in setup.channels}
        made, owner = {}, []
        for i, source in enumerate(known):
            if source.kind in (*CONSTANT, "walk", "drift"):
                made[i] = _error(channels[source.target], source.kind)
            if source.kind in WHITE:
                continue
            count = 1
            if source.kind == "initial" and not source.target:
                count = setup.space.n
            elif source.kind in CONSTANT:
                count = len(made[i].std)
            owner += [i] * count
        moving = [len(made[i].std) for i, s in enumerate(known) if s.kind in ("walk", "drift")]
        white = tuple(i for i, source in enumerate(known) if source.kind in WHITE)
        return cls(tuple(known), np.array(owner, np.intp), white, made, max(moving, default=0))

    def columns(self, place: int) -> NDArray[np.intp]:
        """The columns of a source."""
        return np.flatnonzero(self.owner == place)

    def where(self, *kinds: str) -> list[int]:
        """The sources of some kinds."""
        return [i for i, source in enumerate(self.sources) if source.kind in kinds]

    def start(self, setup: Setup, label: str, n: int, runs: int) -> tuple[Array, Array]:
        """`fixed` and `moving` at the start, of a filter with n coordinates."""
        fixed = np.zeros((runs, n, len(self.owner)))
        size = n + self.width
        moving = np.zeros((runs, len(self.white), size, size))
        of_state = setup.space.n
        root = psd_root(setup.cov)
        for i in self.where("initial"):
            target = self.sources[i].target
            if target:
                at = setup.space.index(target)
                fixed[:, at, self.columns(i)] = root[at, at]
            else:
                fixed[:, :of_state, self.columns(i)] = root
        for i in self.where("offset"):
            column = self.columns(i)[0]
            fixed[:, :of_state, column] = setup.space.minus(setup.mean, setup.prior(label)[0])
        for i in self.where("walk", "drift"):
            variance = self.errors[i].std ** 2
            at = n + np.arange(len(variance))
            moving[:, self.white.index(i), at, at] = variance
        return fixed, moving

    def drift(self, dt: float) -> tuple[Float[Array, "s w"], Float[Array, "s w"]]:
        """What is left of each error that drifts after dt, and the variance of what is new."""
        keep, fresh = np.zeros((2, len(self.white), self.width))
        for i in self.where("walk", "drift"):
            error, at = self.errors[i], self.white.index(i)
            count = len(error.std)
            keep[at, :count], fresh[at, :count] = error.keep(dt), error.root(dt) ** 2
        return keep, fresh

    def variances(
        self, fixed: Float[Array, "run n c"], moving: Float[Array, "run s N N"], n: int
    ) -> tuple[Float[Array, "run source n"], Float[Array, "run n"]]:
        """The mean square error that each source causes, and what the given ones add together.

        The second is (Σ eᵢ)² - Σ eᵢ² over the sources that are no random numbers.
        """
        out = np.zeros((len(fixed), len(self.sources), n))
        belongs = self.owner[:, None] == np.arange(len(self.sources))
        out += (fixed[:, :n] ** 2 @ belongs).mT
        out[:, list(self.white)] += np.diagonal(moving, axis1=-2, axis2=-1)[..., :n]
        given = fixed[:, :n, np.isin(self.owner, self.where(*GIVEN))]
        return out, given.sum(axis=-1) ** 2 - (given**2).sum(axis=-1)


def _error(channel: Channel, kind: str) -> SensorError:
    """The error of a channel as the one kind of source that it is."""
    found = {error.kind: error for error in errors(channel)}
    if kind not in ("bias", "walk"):
        return found[kind]
    zero = np.zeros(channel.space.n)
    return replace(found["bias"], **({"walk": zero} if kind == "bias" else {"std": zero}))
