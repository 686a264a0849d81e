"""The error budget by Monte Carlo: one source at a time switched on, and one at a time off.

Every variant has the same runs and random numbers, so that differences are paired. What the sources
cause each by itself does not add up to the whole where the estimator is not linear: the rest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estbench.budgets.sources import CONDITIONS, Source, grouped, sources
from estbench.budgets.switches import without
from estbench.consistency.intervals import Interval, mean_interval, positive_mean_interval
from estbench.errors import Interrupted
from estbench.experiment import recording
from estbench.experiment.prepared import Setup
from estbench.montecarlo import batch, executors
from estbench.montecarlo.dispatch import Progress
from estbench.montecarlo.pool import work_off
from estbench.shapes import Array, Float
from estbench.study.evaluation import simulated

Key = tuple[str, str]
"""`alone` or `without` and the name of a source; `all` and nothing."""
ALL: Key = ("all", "")


@dataclass(frozen=True, eq=False)
class Sampled:
    """The budget of one estimator, by Monte Carlo; mean square errors, (unit)².

    Attributes:
        sources: those that add an error, then the conditions.
        mse: of each variant, time averages `(run, n)`.
        over_time: of each variant, mean over the runs that did not fail `(time, n)`.
        level: of the intervals.
    """

    sources: tuple[Source, ...]
    mse: dict[Key, Float[Array, "run n"]]
    over_time: dict[Key, Float[Array, "time n"]]
    level: float

    @property
    def runs(self) -> int:
        """Of each variant."""
        return len(self.mse[ALL])

    def total(self) -> tuple[Interval, ...]:
        """With all sources, each coordinate."""
        return tuple(positive_mean_interval(v, self.level) for v in self.mse[ALL].T)

    def alone(self, source: Source) -> tuple[Interval, ...]:
        """With this source and no other."""
        return tuple(
            positive_mean_interval(v, self.level) for v in self.mse["alone", source.name].T
        )

    def removed(self, source: Source) -> tuple[Interval, ...]:
        """By how much it is less without this source."""
        change = self.mse[ALL] - self.mse["without", source.name]
        return tuple(mean_interval(v, self.level) for v in change.T)

    def rest(self) -> tuple[Interval, ...]:
        """What is left: the whole, less what each source causes alone."""
        parts = [v for (what, _), v in self.mse.items() if what == "alone"]
        return tuple(mean_interval(v, self.level) for v in (self.mse[ALL] - sum(parts)).T)


def sampled(
    setup: Setup,
    label: str,
    *,
    by_source: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Sampled:
    """The budget of an estimator over all runs of an experiment.

    Args:
        setup: the experiment.
        label: of the estimator.
        by_source: whether each coordinate of the initial error and each component of the process
            noise is a source; else these are one source each.
        workers: count of threads.
        progress: called with the count of finished runs of variants, and of all.

    Raises:
        EstbenchError: the estimator fails in a variant.
        Interrupted: Ctrl-C came.
    """
    every = sources(setup, label)
    parts = every if by_source else grouped(every)
    variants = {ALL: setup}
    adding = [s for s in parts if s.kind not in CONDITIONS]
    for source in parts:
        variants["without", source.name] = without(setup, label, [source])
    for source in adding:
        others = [s for s in adding if s is not source]
        variants["alone", source.name] = without(setup, label, others)
    count = setup.scenario.simulation.runs
    size = min(batch.default_batch_size(setup, "summary"), count)
    tasks = [(key, at) for key in variants for at in range(0, count, size)]
    found: dict[tuple[Key, int], _Squares] = {}
    errors: list[Exception] = []

    def finished(task: tuple[Key, int], squares: _Squares) -> None:
        found[task] = squares
        if progress is not None:
            done = sum(len(part.mse) for part in found.values())
            progress(done, count * len(variants))

    def work(
        task: tuple[Key, int], stop: Callable[[], bool], prepared: Sequence[int]
    ) -> _Squares | None:
        key, start = task
        return _squares(variants[key], label, range(start, min(start + size, count)), stop)

    using = executors.pool("threads", executors.worker_count(workers))
    stopped = work_off(work, tasks, using, (), finished, lambda _, error: errors.append(error))
    if stopped:
        raise Interrupted("interrupted before all variants were finished: there is no result")
    if errors:
        raise errors[0]
    parts_of = {key: [found[key, at] for at in range(0, count, size)] for key in variants}
    mse = {key: np.concatenate([part.mse for part in own]) for key, own in parts_of.items()}
    over_time = {
        key: np.sum([part.total for part in own], axis=0) / max(1, sum(part.good for part in own))
        for key, own in parts_of.items()
    }
    return Sampled(parts, mse, over_time, setup.scenario.consistency.level)


class _Squares(NamedTuple):
    """Squared errors of one variant on some runs.

    Attributes:
        mse: averages over time; NaN for runs that failed.
        total: sums over the runs that did not fail.
        good: how many these are.
    """

    mse: Float[Array, "run n"]
    total: Float[Array, "time n"]
    good: int


def _squares(
    setup: Setup, label: str, runs: Sequence[int], stop: Callable[[], bool]
) -> _Squares | None:
    """The squared errors of one variant; None when stopped."""
    found = recording.estimated(setup, label, runs, simulated(setup, runs), stop=stop)
    if found is None:
        return None
    square = found[0].error ** 2
    counted = (setup.times > setup.scenario.consistency.burn_in) & (setup.times > 0)
    good = np.isfinite(square).all(axis=(0, 2))
    return _Squares(square[counted].mean(axis=0), square[:, good].sum(axis=1), int(good.sum()))
