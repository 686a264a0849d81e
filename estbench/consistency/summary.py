"""From the merged record of one estimator to its summary."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.consistency import statistics
from estbench.consistency.declaration import Sample, Statistic
from estbench.consistency.fields import Record
from estbench.consistency.intervals import NONE
from estbench.consistency.nees import judge
from estbench.consistency.statistics import ANEES, DIVERGED, Failure, Summary
from estbench.estimators.beliefs import Fault
from estbench.scenario.schema import ConsistencySection
from estbench.shapes import Array, Float


def summarize(
    label: str,
    record: Record,
    runs: Sequence[int],
    times: Float[Array, " time"],
    section: ConsistencySection,
) -> Summary:
    """The summary of one estimator.

    Args:
        label: the estimator's label.
        record: as `records.merge` gives it.
        runs: numbers of the runs in the record.
        times: of the instants and the start, s.
        section: level and tolerance of the verdict.
    """
    sample = Sample(record, section.level, len(times) - 1)
    values: dict[str, Any] = {
        s.name: s.of(sample) if s.variables.keys() <= record.keys() else _unknown(s, record)
        for s in statistics.STATISTICS
    }
    anees, diverged = values[ANEES.name], values[DIVERGED.name]
    failures = (
        Failure(int(runs[i]), float(times[record["fault_step"][i]]), Fault(record["fault"][i]).text)
        for i in np.flatnonzero(record["fault"]).tolist()
    )
    return Summary(
        label=label,
        runs=len(runs),
        verdict=judge(anees, diverged.value, section.tolerance),
        failures=tuple(failures),
        late=int(record["late"].sum()),
        **values,
    )


def _unknown(s: Statistic, record: Record) -> Any:
    """The value of a statistic whose variables a store of an earlier version lacks."""
    value = np.nan if s.form == "number" else NONE
    return value if s.per == "run" else (value,) * record["mse"].shape[1]
