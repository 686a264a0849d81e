"""What a study found: the records of every variant, their statistics, and what failed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from estbench.consistency import statistics
from estbench.consistency.fields import Record
from estbench.consistency.intervals import Interval
from estbench.consistency.statistics import Summary
from estbench.consistency.summary import summarize
from estbench.study.compute import Outcomes
from estbench.study.design import Study
from estbench.study.evaluation import KEPT, failed
from estbench.study.store import coordinate
from estbench.tables.cells import value_of


@dataclass(frozen=True, eq=False)
class Findings:
    """The results of a study.

    Attributes:
        study: what was computed.
        names, units: of the tangent coordinates.
        channels: their names.
        times: (variant,) instants of each, s.
        runs: numbers of the runs that every variant has.
        records: for each variant, label -> record of these runs.
        failures: (variant, label) -> why the estimator failed.
        folder: of the stored results, or None.
        interrupted: whether Ctrl-C cut it short.
        notices: assumptions and warnings.
    """

    study: Study
    names: tuple[str, ...]
    units: tuple[str, ...]
    channels: tuple[str, ...]
    times: tuple[Any, ...]
    runs: tuple[int, ...]
    records: tuple[Mapping[str, Record], ...]
    failures: Mapping[tuple[int, str], str]
    folder: Path | None = None
    interrupted: bool = False
    notices: tuple[str, ...] = ()

    @cached_property
    def summaries(self) -> tuple[dict[str, Summary], ...]:
        """For each variant, label -> summary."""
        every = range(len(self.records))
        return tuple({label: self.summary(i, label) for label in self.records[i]} for i in every)

    def summary(self, variant: int, label: str) -> Summary:
        """The summary of one estimator of one variant."""
        scenario = self.study.variants[variant]
        return summarize(
            label, self.records[variant][label], self.runs, self.times[variant],
            scenario.consistency, self.names, self.channels, scenario.contact,
        )  # fmt: skip

    def dataset(self) -> xr.Dataset:
        """Statistics with the varied keys and the estimator as dimensions.

        A statistic `x` with an interval has `x_low` and `x_high` beside it; those per coordinate
        have the dimension `coordinate`. `verdict` is text. Names are those of the JSON of `run`,
        with `_` for the dot.
        """
        study = self.study
        dims, shape = (*study.dims, "estimator"), (*study.shape, len(study.labels))
        flat = [by_label[label] for by_label in self.summaries for label in study.labels]
        found: dict[str, Any] = {
            "verdict": (dims, np.array([str(s.verdict) for s in flat], object).reshape(shape))
        }
        for s in statistics.STATISTICS:
            values = np.array([_numbers(value_of(summary, s)) for summary in flat])
            name, tail = s.json_key.replace(".", "_"), values.shape[2:]
            inner = ("coordinate",) if s.per == "coordinate" else ()
            suffixes = ("",) if s.form == "number" else ("", "_low", "_high")
            for i, suffix in enumerate(suffixes):
                attrs = {"meaning": s.meaning, "units": s.unit} if not i else {}
                data = values[:, i].reshape(*shape, *tail)
                found[f"{name}{suffix}"] = ((*dims, *inner), data, attrs)
        coords: dict[str, Any] = {
            "estimator": coordinate(study.labels),
            "coordinate": coordinate(self.names),
            "unit": ("coordinate", coordinate(self.units)),
        }
        for axis in study.axes:
            own = coordinate(axis.values)
            coords[axis.key] = own if study.grid else (study.dims[0], own)
        attrs = {
            "scenario": study.scenario.name, "seed": study.scenario.simulation.seed,
            "runs": len(self.runs), "notices": list(self.notices),
            "folder": "" if self.folder is None else str(self.folder),
        }  # fmt: skip
        return xr.Dataset(found, coords, attrs)


def collect(
    study: Study,
    pieces: Mapping[tuple[int, int], Outcomes],
    batches: Sequence[range],
    sizes: Mapping[str, int],
) -> tuple[tuple[int, ...], tuple[dict[str, Record], ...], dict[tuple[int, str], str]]:
    """The records of the batches that every group has.

    Returns:
        Numbers of the runs, the records of each variant, and (variant, label) -> failure.
    """
    groups = range(len(study.groups))
    whole = [b for b in range(len(batches)) if all((g, b) in pieces for g in groups)]
    records: list[dict[str, Record]] = [{} for _ in study.variants]
    failures: dict[tuple[int, str], str] = {}
    for g, group in enumerate(study.groups):
        for i, index in enumerate(group.ravel().tolist()):
            for label in study.labels:
                parts = []
                for b in whole:
                    outcome = pieces[g, b][i][label]
                    if isinstance(outcome, str):
                        failures.setdefault((index, label), outcome)
                        outcome = failed(dict(sizes), len(batches[b]))
                    parts.append(outcome)
                if parts:
                    records[index][label] = {
                        name: np.concatenate([part[name] for part in parts]) for name in KEPT
                    }
    runs = tuple(run for b in whole for run in batches[b])
    return runs, tuple(records), failures


def _numbers(value: Any) -> Any:
    """A statistic as value, low, high along the first axis."""
    if isinstance(value, Interval):
        return [value.value, value.low, value.high]
    if isinstance(value, tuple):
        return np.array([_numbers(v) for v in value]).T
    return [value]
