"""From the records of many runs to figures one can publish: accuracy, consistency, cost."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.consistency.intervals import wilson
from estbench.consistency.nees import (
    Interval,
    Verdict,
    judge,
    mean_interval,
    positive_mean_interval,
)
from estbench.consistency.records import Record
from estbench.estimators.beliefs import Fault
from estbench.scenario.schema import ConsistencySection
from estbench.shapes import Array


@dataclass(frozen=True)
class Failure:
    """One run that failed: its number, when, and why."""

    run: int
    time: float
    reason: str


@dataclass(frozen=True, eq=False)
class Summary:
    """What is said of one estimator.

    Means are over the runs that did not diverge, medians over all; the share says how many did.

    Attributes:
        label: the estimator's label.
        runs: how many runs.
        verdict: in a word, from ANEES/n across runs.
        anees: ANEES/n with its interval across runs; 1 is consistent.
        anees_median: median over runs of their time-averaged NEES/n.
        anis: the same for NIS/m.
        lag_one: lag-one correlation of the whitened innovations; 0 for a consistent filter.
        diverged: share of runs.
        diverged_interval: the share with its Wilson interval.
        rmse: per coordinate, in its unit, with an interval across runs.
        rmse_median: median over runs of their RMSE `(n,)`.
        std: root of the mean variance the filter reports `(n,)`.
        cost: microseconds of one core per run and step, predict and update.
        failures: the runs with a numerical failure.
        late: readings, of all runs, that came after the window and were not fused.
    """

    label: str
    runs: int
    verdict: Verdict
    anees: Interval
    anees_median: float
    anis: Interval
    lag_one: Interval
    diverged: float
    diverged_interval: Interval
    rmse: tuple[Interval, ...]
    rmse_median: Array
    std: Array
    cost: float
    failures: tuple[Failure, ...]
    late: int = 0


def summarize(
    label: str, record: Record, runs: Sequence[int], times: Array, section: ConsistencySection
) -> Summary:
    """The summary of one estimator's merged record.

    Args:
        label: the estimator's label.
        record: as `records.merge` gives it.
        runs: numbers of the runs in the record.
        times: `(K + 1,)` s.
        section: level and tolerance of the verdict.
    """
    good = ~record["diverged"].astype(bool)
    share = float(np.mean(~good))
    level = section.level
    anees = positive_mean_interval(record["anees"][good], level)
    failed = np.flatnonzero(record["fault"])
    with np.errstate(invalid="ignore"):
        mse = [positive_mean_interval(column, level) for column in record["mse"][good].T]
        every = np.where(np.isfinite(record["mse"]), record["mse"], np.inf)
    return Summary(
        label=label,
        runs=len(runs),
        verdict=judge(anees, share, section.tolerance),
        anees=anees,
        anees_median=float(
            np.median(np.where(np.isfinite(record["anees"]), record["anees"], np.inf))
        ),
        anis=positive_mean_interval(record["anis"][good], level),
        lag_one=mean_interval(record["lag_one"][good], level),
        diverged=share,
        diverged_interval=wilson(int((~good).sum()), len(good), level),
        rmse=tuple(
            Interval(*(float(np.sqrt(max(x, 0.0))) for x in (i.value, i.low, i.high))) for i in mse
        ),
        rmse_median=np.sqrt(np.median(every, axis=0)),
        std=np.sqrt(record["variance"][good].mean(axis=0))
        if good.any()
        else np.full(len(mse), np.nan),
        cost=1e6 * float(record["cpu_time"].mean()) / (len(times) - 1),
        failures=tuple(
            Failure(
                int(runs[i]), float(times[record["fault_step"][i]]), Fault(record["fault"][i]).text
            )
            for i in failed.tolist()
        ),
        late=int(record["late"].sum()),
    )
