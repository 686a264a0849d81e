"""The stores of a report: the finished runs of each, and one entry per estimator."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from estbench.analysis import load as stored
from estbench.analysis.stored import Stored
from estbench.consistency.fields import Record
from estbench.consistency.statistics import Summary
from estbench.errors import StoreError, did_you_mean


@dataclass(frozen=True, eq=False)
class Entry:
    """One estimator of one source.

    Attributes:
        key: its name on the page, unique among the entries.
        label: its name in the store.
        source: the store.
        record: per-run and per-step arrays of the finished runs (`records.SUMMARY`).
        summary: the statistics of that record.
    """

    key: str
    label: str
    source: Stored
    record: Record
    summary: Summary

    @property
    def sample(self) -> Record:
        """The record of the runs; of a log, which is one run, that of its parts."""
        return self.record if self.source.log is None else self.source.samples[self.label]

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which runs of the record did not diverge."""
        return ~self.record["diverged"].astype(bool)

    @property
    def group(self) -> xr.Dataset:
        """The estimator's arrays in the store, lazily read."""
        return self.source.group(self.label)

    def position(self, run: int) -> int | None:
        """Index of a run in the store, or None if it is not there."""
        found = np.flatnonzero(read(self.source.tree, "run") == run)
        return int(found[0]) if len(found) and run in self.source.runs else None

    def no_run(self, run: int) -> StoreError:
        """The error for a run that the store does not have."""
        runs = self.source.runs
        return StoreError(
            f"{self.source.folder} has no finished run {run}; it has {len(runs)} runs, "
            f"{runs.min()} to {runs.max()}"
        )


def load(folders: Sequence[str | Path], estimators: Sequence[str] = ()) -> list[Entry]:
    """The estimators of results folders, in order.

    Args:
        folders: written by `estbench run`.
        estimators: labels to show; default all.

    Raises:
        StoreError: a folder is no results folder, has no finished run, or their states differ;
            or there is no estimator of that label.
    """
    sources = stored.load_all(folders)
    entries = []
    for source in sources:
        for label, record in source.records.items():
            if estimators and label not in estimators:
                continue
            key = label if len(sources) == 1 else f"{source.title}/{label}"
            entries.append(Entry(key, label, source, record, source.summaries[label]))
    labels = sorted({label for source in sources for label in source.records})
    for wanted in estimators:
        if wanted not in labels:
            raise StoreError(f"no estimator '{wanted}' there{did_you_mean(wanted, labels)}")
    return entries


def read(tree: xr.DataTree, path: str) -> NDArray[Any]:
    """An array of a store, in memory."""
    return stored.array(tree, path).values
