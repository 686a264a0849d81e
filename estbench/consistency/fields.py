"""A stored variable: its dimensions, type and meaning, and how the traces of one batch give it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.consistency.blocks import Block, means
from estbench.consistency.coverage import inside
from estbench.consistency.sums import Around, Mean, Ratio, Sum, Total
from estbench.inference.traces import Traces
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask, Shaped

Record = dict[str, NDArray[Any]]
"""Variables of one estimator by name."""

STEADY = 1e-3
"""A covariance whose log σ² changes by less during a run is constant."""
PHASES = ("flight", "stance", "event")
"""Of contact: nothing is touched, something is, an event is near. Each instant is in one."""
RUN, STEP, EACH = ("run",), ("batch", "time"), ("run", "time")


@dataclass(frozen=True)
class Field:
    """Description of one variable.

    Attributes:
        dims: names of its dimensions. The first one says how batches merge: along `run` their
            values follow each other; along `batch` each batch has one row of sums over its runs,
            and readers add the rows.
        dtype: numpy's code of its type.
        meaning: one line, with the unit where it is not 1.
    """

    dims: tuple[str, ...]
    dtype: str
    meaning: str


@dataclass(frozen=True)
class Recorded(Field):
    """A variable that is computed from the traces of one batch.

    Attributes:
        of: computes the values, their dimensions in the order of `dims`, or the sums that give
            them. Sums add up over the windows of a long run; what is none is computed from a
            sample of its instants (`consistency.windows`).
    """

    of: Callable[["BatchTraces"], NDArray[Any] | Sum]

    def values(self, batch: "BatchTraces") -> NDArray[Any]:
        """The values of a batch."""
        found = self.of(batch)
        return found if isinstance(found, np.ndarray) else found.value


@dataclass(frozen=True, eq=False)
class BatchTraces:
    """The traces of one batch, with the steps and the runs that count in averages.

    Attributes:
        traces: time-major, `(time, run, ...)`.
        times: of the instants and the start, s.
        settled: instants that count in averages over time.
        diverged: runs that count in no sum over runs.
        blocks: of the settled instants.
        phases: phase of contact of each instant (see `phases.PHASES`); None if it is not known.
        since: of a window of a run: the runs with an event of contact before it; None for none.
    """

    traces: Traces
    times: Float[Array, " time"]
    settled: Bool[Mask, " time"]
    diverged: Bool[Mask, " run"]
    blocks: tuple[Block, ...]
    phases: Bool[Mask, "time run phase"] | None = None
    since: Bool[Mask, " run"] | None = None

    @property
    def n(self) -> int:
        """Dimension of the error."""
        return self.traces.error.shape[-1]

    @property
    def runs(self) -> int:
        """How many runs the batch has."""
        return len(self.diverged)

    @cached_property
    def square(self) -> Float[Array, "time run n"]:
        """Squared error, (unit)²."""
        return self.traces.error**2

    @cached_property
    def variance(self) -> Float[Array, "time run n"]:
        """Variance that the filter reports, (unit)²."""
        return self.traces.std**2

    @property
    def bound(self) -> Float[Array, "time run n"]:
        """Numbers whose mean over the runs is the bound on the mean square error, (unit)²."""
        known = self.traces.bound
        return np.full_like(self.traces.error, np.nan) if known is None else known

    @cached_property
    def bounded(self) -> Bool[Mask, "time run"]:
        """Where the bound is known."""
        return np.asarray(np.isfinite(self.bound).all(axis=-1))

    @cached_property
    def _inside(self) -> Mean:
        """Share of the settled steps with an error of at most 1, 2, 3σ `(run, n, 3)`."""
        return inside(self.traces.error[self.settled], self.traces.sigma[self.settled])

    def inside(self, which: int) -> Mean:
        """Share of the settled steps with an error of at most `SIGMAS[which]` σ `(run, n)`."""
        found = self._inside
        return Mean(found.total[..., which], found.number[..., 0])

    @cached_property
    def nis(self) -> Float[Array, "time run"]:
        """NIS at every instant, not divided by m; NaN where nothing arrived."""
        return np.concatenate([np.full((1, self.runs), np.nan), self.traces.nis])

    @cached_property
    def dof(self) -> Int[Ints, "time run"]:
        """Dimension m of the innovation at every instant."""
        return np.concatenate([np.zeros((1, self.runs), np.int64), self.traces.dof])

    def average(self, values: Shaped[NDArray[Any], "time run *any"]) -> Mean:
        """Mean over the settled instants `(run, ...)`.

        A run whose values are NaN from its failure on has the average NaN.
        """
        chosen = values[self.settled]
        return Mean(chosen.sum(axis=0), len(chosen))

    @cached_property
    def scaled(self) -> Float[Array, "time run n"]:
        """e/σ; NaN where the filter reports no variance."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.traces.error / self.traces.sigma

    @cached_property
    def uncertain(self) -> Bool[Mask, "time run n"]:
        """Where the filter reports a variance: a coordinate known exactly has none."""
        return self.traces.sigma > 0

    def in_blocks(self, values: Float[Array, "time run *any"], counted: Bool[Mask, "..."]) -> Mean:
        """Mean over the instants of each block `(run, block, ...)`; NaN where none counts."""
        return means(values, counted, [b.members(self.times) for b in self.blocks])

    @cached_property
    def judged(self) -> Bool[Mask, "time run"]:
        """Where NEES says something: all is known exactly, and rightly so, elsewhere."""
        return (self.traces.rank > 0) | ~(self.traces.nees == 0)

    def in_phases(
        self, values: Float[Array, "time run *any"], counted: Bool[Mask, "time run"] | None = None
    ) -> Mean:
        """Mean over the settled instants of each phase `(run, phase, ...)`; NaN without any."""
        if self.phases is None:
            return Mean(np.zeros((self.runs, len(PHASES), *values.shape[2:])), 0)
        parts = self.phases if counted is None else self.phases & counted[..., None]
        wide = parts.reshape(*parts.shape, *[1] * (values.ndim - 2))
        found = [means(values, wide[:, :, p], [self.settled]) for p in range(len(PHASES))]
        totals, numbers = ([getattr(m, name) for m in found] for name in ("total", "number"))
        return Mean(np.concatenate(totals, axis=1), np.concatenate(numbers, axis=1))

    def around_contact(self, values: Float[Array, "time run"]) -> Around:
        """Mean over the settled instants before the first event of contact, and from it on.

        Its window belongs to the event. NaN for a run without an event.
        """
        if self.phases is None:
            return Around(Mean(np.zeros((self.runs, 2)), 0), np.zeros(self.runs, bool))
        event = self.phases[..., PHASES.index("event")]
        since = np.logical_or.accumulate(event, axis=0)
        since = since if self.since is None else since | self.since
        parts = [_mean(values[self.settled], (part & self.judged)[self.settled])
                 for part in (~since, since)]  # fmt: skip
        totals, numbers = ([getattr(m, name) for m in parts] for name in ("total", "number"))
        return Around(Mean(np.stack(totals, axis=-1), np.stack(numbers, axis=-1)), since[-1])

    def phase_steps(self) -> Total:
        """How many settled instants each phase has; 0 where the phases are not known."""
        if self.phases is None:
            return Total(np.zeros((self.runs, len(PHASES)), np.int64))
        return Total(self.phases[self.settled].sum(axis=0))

    @cached_property
    def normalized_update(self) -> Float[Array, "time run"]:
        """NIS/m at every instant; NaN where nothing arrived."""
        return self.nis / np.maximum(self.dof, 1)

    @cached_property
    def log_variance(self) -> Float[Array, "settled run n"]:
        """Logarithm of σ² at the settled instants; 0 where the filter reports none."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.uncertain, 2 * np.log(self.traces.std), 0.0)[self.settled]

    def by_size(self, values: Float[Array, "time run"]) -> Float[Array, "run 2"]:
        """Mean over the instants whose covariance is below the run's median, and over the others.

        The size of a covariance is the mean over the coordinates of log σ², which is computed from
        what the filter reports alone: the mean of NEES/n of a consistent filter is 1 in both. NaN
        for a run whose covariance hardly changes (by less than `STEADY` in σ²).
        """
        return _by_size(self.log_variance.mean(axis=-1), values[self.settled],
                        self.judged[self.settled])  # fmt: skip

    def coordinates_by_size(self) -> Float[Array, "run 2 n"]:
        """The same of (error/σ)² of each coordinate, by its own variance."""
        known = self.uncertain[self.settled]
        found = _by_size(self.log_variance, self.scaled[self.settled] ** 2, known)
        return np.swapaxes(found, 1, 2)

    def along(self) -> Mean:
        """Mean over the settled instants of the square along each direction `(run, direction)`."""
        values = self.traces.along[self.settled]
        return _mean(values, np.isfinite(values))

    def channel_nis(self) -> Mean:
        """Mean over the settled updates of NIS/m of each channel `(run, channel)`.

        NaN where none arrived.
        """
        values = self.traces.channel_nis[self.settled[1:]]
        lost = ~np.isfinite(self.traces.nis[self.settled[1:]]) & (
            self.traces.dof[self.settled[1:]] > 0
        )
        return _mean(values, ~np.isnan(values) | lost[..., None])

    def summed(self, values: Shaped[NDArray[Any], "step run"]) -> Total:
        """Sum over the settled instants `(run,)`."""
        return Total(values[self.settled[1:]].sum(axis=0))

    def total(
        self, values: Shaped[NDArray[Any], "time run *any"]
    ) -> Shaped[NDArray[Any], "1 time *any"]:
        """Sum over the runs that did not diverge."""
        return values[:, ~self.diverged].sum(axis=1)[None]

    def nis_total(self) -> Float[Array, "1 time"]:
        """`total` of NIS, where nothing arrived 0."""
        return np.nansum(self.nis[:, ~self.diverged], axis=1)[None]

    @cached_property
    def normalized(self) -> Float[Array, "time run"]:
        """NEES divided by its degrees of freedom, by 1 where there are none."""
        return self.traces.nees / np.maximum(self.traces.rank, 1)

    def normalized_nees(self) -> Ratio:
        """Mean of NEES over the settled instants `(run,)`, over that of its degrees of freedom.

        NaN where all is known exactly, and the estimate is right.
        """
        return Ratio(self.average(self.traces.nees), self.average(self.traces.rank))

    @cached_property
    def known(self) -> Mean:
        """Share of the settled instants at which each coordinate is known exactly `(run, n)`."""
        return self.average(self.traces.std == 0)

    def normalized_nis(self) -> Mean:
        """Mean over the settled updates of NIS/m `(run,)`; NaN without an update."""
        traces, late = self.traces, self.settled[1:]
        ratio = np.where(traces.dof > 0, traces.nis / np.maximum(traces.dof, 1), 0.0)[late]
        return Mean(ratio.sum(axis=0), (traces.dof[late] > 0).sum(axis=0))


def _mean(values: Float[Array, "time run *any"], counted: Bool[Mask, "time run *any"]) -> Mean:
    """Mean over the instants of the values that count `(run, ...)`; NaN where none does."""
    return Mean(np.where(counted, values, 0.0).sum(axis=0), counted.sum(axis=0))


def _by_size(
    size: Float[Array, "time run *any"],
    values: Float[Array, "time run *any"],
    counted: Bool[Mask, "time run *any"],
) -> Float[Array, "run *any 2"]:
    """Mean of values over the instants with a size below the run's median, and over the others.

    Args:
        size: logarithm of a variance.
        values: of each instant.
        counted: the values that count; none of a run whose size hardly changes does.
    """
    with np.errstate(invalid="ignore"):
        small = size < np.median(size, axis=0)
    counted = counted & (np.ptp(size, axis=0) > STEADY)
    parts = [_mean(values, part & counted).value for part in (small, ~small)]
    return np.stack(parts, axis=-1)


def run_major(name: str) -> Callable[[BatchTraces], Shaped[NDArray[Any], "run time ..."]]:
    """Reads a trace `(time, run, ...)` as it is stored, `(run, time, ...)`.

    Args:
        name: attribute of `BatchTraces`, else of `Traces`.
    """

    def of(batch: BatchTraces) -> Shaped[NDArray[Any], "run time ..."]:
        owner = batch if hasattr(batch, name) else batch.traces
        return np.swapaxes(getattr(owner, name), 0, 1)

    return of
