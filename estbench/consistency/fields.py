"""A stored variable: its dimensions, type and meaning, and how the traces of one batch give it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.consistency.coverage import inside
from estbench.inference.traces import Traces
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask, Shaped

Record = dict[str, NDArray[Any]]
"""Variables of one estimator by name."""

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
        of: computes the values, their dimensions in the order of `dims`.
    """

    of: Callable[["BatchTraces"], NDArray[Any]]


@dataclass(frozen=True, eq=False)
class BatchTraces:
    """The traces of one batch, with the steps and the runs that count in averages.

    Attributes:
        traces: time-major, `(time, run, ...)`.
        settled: instants that count in averages over time.
        diverged: runs that count in no sum over runs.
    """

    traces: Traces
    settled: Bool[Mask, " time"]
    diverged: Bool[Mask, " run"]

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

    @cached_property
    def inside(self) -> Float[Array, "run n 3"]:
        """Share of the settled steps with an error of at most 1, 2, 3σ."""
        return inside(self.traces.error[self.settled], self.traces.std[self.settled])

    @cached_property
    def nis(self) -> Float[Array, "time run"]:
        """NIS at every instant, not divided by m; NaN where nothing arrived."""
        return np.concatenate([np.full((1, self.runs), np.nan), self.traces.nis])

    @cached_property
    def dof(self) -> Int[Ints, "time run"]:
        """Dimension m of the innovation at every instant."""
        return np.concatenate([np.zeros((1, self.runs), np.int64), self.traces.dof])

    def average(self, values: Float[Array, "time run *any"]) -> Float[Array, " run *any"]:
        """Mean over the settled instants.

        A run whose values are NaN from its failure on has the average NaN.
        """
        return values[self.settled].mean(axis=0)

    def total(
        self, values: Shaped[NDArray[Any], "time run *any"]
    ) -> Shaped[NDArray[Any], "1 time *any"]:
        """Sum over the runs that did not diverge."""
        return values[:, ~self.diverged].sum(axis=1)[None]

    def nis_total(self) -> Float[Array, "1 time"]:
        """`total` of NIS, where nothing arrived 0."""
        return np.nansum(self.nis[:, ~self.diverged], axis=1)[None]

    def normalized_nis(self) -> Float[Array, " run"]:
        """Mean over the settled updates of NIS/m; NaN without an update."""
        traces, late = self.traces, self.settled[1:]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(traces.dof > 0, traces.nis / np.maximum(traces.dof, 1), 0.0)[late]
            updates = (traces.dof[late] > 0).sum(axis=0)
            return np.where(updates > 0, ratio.sum(axis=0) / np.maximum(updates, 1), np.nan)


def run_major(name: str) -> Callable[[BatchTraces], Shaped[NDArray[Any], "run time ..."]]:
    """Reads a trace `(time, run, ...)` as it is stored, `(run, time, ...)`.

    Args:
        name: attribute of `BatchTraces`, else of `Traces`.
    """

    def of(batch: BatchTraces) -> Shaped[NDArray[Any], "run time ..."]:
        owner = batch if hasattr(batch, name) else batch.traces
        return np.swapaxes(getattr(owner, name), 0, 1)

    return of
