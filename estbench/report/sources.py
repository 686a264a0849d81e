"""Stores as a report reads them: the finished runs of each, and one entry an estimator."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from estbench import scenario as scenarios
from estbench.errors import StoreError, did_you_mean
from estbench.records import SUMMARY, Record
from estbench.sections import Scenario
from estbench.statistics import Summary, summarize
from estbench.store import COSTS, SCENARIO, STORE, open_results

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Source:
    """One store.

    Attributes:
        folder: where it lies.
        title: its name on the page, unique among the sources.
        scenario: as it was run.
        attrs: provenance: seed, versions, time.
        names, units: of the tangent coordinates `(n,)`.
        times: instants `(K + 1,)`, s.
        runs: numbers of the finished runs.
        total: count of runs that were asked for.
        batches: positions of the runs of each finished batch.
        tree: the store, lazily read.
    """

    folder: Path
    title: str
    scenario: Scenario
    attrs: dict[str, Any]
    names: tuple[str, ...]
    units: tuple[str, ...]
    times: Array
    runs: NDArray[np.int64]
    total: int
    batches: tuple[slice, ...]
    tree: xr.DataTree

    @property
    def n(self) -> int:
        """Dimension of the tangent space."""
        return len(self.names)

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Instants that count in averages `(K + 1,)`."""
        return (self.times > self.scenario.consistency.burn_in) & (self.times > 0)

    @property
    def has_traces(self) -> bool:
        """Whether errors and estimates of every run were kept."""
        return "error" in self.group(self.attrs["estimators"][0])

    def group(self, label: str) -> xr.Dataset:
        """The arrays of an estimator, lazily read."""
        node = self.tree[label]
        assert isinstance(node, xr.DataTree)
        return node.to_dataset()

    @property
    def level(self) -> float:
        """Confidence level of bands and intervals."""
        return self.scenario.consistency.level


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
    source: Source
    record: Record
    summary: Summary

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which runs of the record did not diverge."""
        return ~self.record["diverged"].astype(bool)

    @property
    def group(self) -> xr.Dataset:
        """The estimator's arrays in the store, lazily read."""
        return self.source.group(self.label)

    def position(self, run: int) -> int | None:
        """Where a run stands in the store, or None if it is not there."""
        found = np.flatnonzero(read(self.source.tree, "run") == run)
        return int(found[0]) if len(found) and run in self.source.runs else None


def load(folders: Sequence[str | Path], estimators: Sequence[str] = ()) -> list[Entry]:
    """The estimators of some results folders, in order.

    Args:
        folders: as `estbench run` wrote them.
        estimators: labels to take; default all.

    Raises:
        StoreError: a folder is no results folder, has no finished run, or their states differ;
            or there is no estimator of that label.
    """
    paths = [Path(folder) for folder in folders]
    titles = _titles(paths)
    sources = [_source(path, title) for path, title in zip(paths, titles)]
    first = sources[0]
    for other in sources[1:]:
        if other.names != first.names:
            raise StoreError(
                f"{other.folder} estimates {', '.join(other.names)} but {first.folder} "
                f"{', '.join(first.names)}; make one report for each robot"
            )
    entries = []
    for source in sources:
        for label in source.attrs["estimators"]:
            if estimators and label not in estimators:
                continue
            key = label if len(sources) == 1 else f"{source.title}/{label}"
            entries.append(_entry(source, label, key))
    labels = sorted({label for source in sources for label in source.attrs["estimators"]})
    for wanted in estimators:
        if wanted not in labels:
            raise StoreError(f"no estimator '{wanted}' there{did_you_mean(wanted, labels)}")
    return entries


def read(tree: xr.DataTree, path: str) -> NDArray[Any]:
    """An array of a store, in memory."""
    return array(tree, path).values


def array(tree: xr.DataTree, path: str) -> xr.DataArray:
    """An array of a store, lazily read.

    Raises:
        KeyError: there is no such array.
    """
    node = tree[path]
    if not isinstance(node, xr.DataArray):
        raise KeyError(path)
    return node


def _titles(paths: Sequence[Path]) -> list[str]:
    """The folders' names, with as many parents as it takes to tell them apart."""
    parts = [path.resolve().parts for path in paths]
    if len(set(parts)) < len(parts):
        raise StoreError("a results folder is named twice; name each once")
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]


def _source(folder: Path, title: str) -> Source:
    if (folder / STORE).is_dir() and not (folder / SCENARIO).is_file():
        raise StoreError(f"{folder} holds no {SCENARIO}; name a folder that `estbench run` wrote")
    tree = open_results(folder)
    try:
        done = read(tree, "done").astype(bool)
        attrs = {str(key): value for key, value in tree.attrs.items()}
        label = attrs["estimators"][0]
        size = int(attrs["batch_size"])
        count = array(tree, f"{label}/count").sizes["batch"]
        units = tuple(str(u) for u in read(tree, "unit"))
        numbers = read(tree, "run")
    except KeyError as error:
        raise StoreError(f"{folder} is not a store of estbench: it holds no {error}") from None
    slices = [slice(b * size, min((b + 1) * size, len(done))) for b in range(count)]
    finished = tuple(s for s in slices if done[s].all())
    if not finished:
        raise StoreError(f"{folder} has no finished run yet; wait for the first batch")
    runs = np.concatenate([numbers[s] for s in finished])
    return Source(
        folder=folder,
        title=title,
        scenario=scenarios.load(folder),
        attrs=attrs,
        names=tuple(str(name) for name in read(tree, "coordinate")),
        units=units,
        times=read(tree, "time"),
        runs=runs,
        total=len(done),
        batches=finished,
        tree=tree,
    )


def _entry(source: Source, label: str, key: str) -> Entry:
    group = source.group(label)
    size = int(source.attrs["batch_size"])
    batches = [s.start // size for s in source.batches]
    whole = len(source.runs) == source.total
    keep = np.concatenate([np.arange(s.start, s.stop) for s in source.batches])
    record: Record = {}
    for name in SUMMARY:
        if name in group:
            value = group[name].values
            if not whole:
                value = value[batches if group[name].dims[0] == "batch" else keep]
            record[name] = value
    record["cpu_time"] = np.concatenate(
        [
            np.full(s.stop - s.start, _cost(source, label, s, b))
            for s, b in zip(source.batches, batches)
        ]
    )
    summary = summarize(
        label, record, source.runs.tolist(), source.times, source.scenario.consistency
    )
    return Entry(key, label, source, record, summary)


def _cost(source: Source, label: str, runs: slice, batch: int) -> float:
    """Core time of each run of a batch, s; NaN where it was not kept."""
    try:
        text = (source.folder / COSTS / f"{batch}.json").read_text(encoding="utf-8")
        return float(json.loads(text)[label]) / (runs.stop - runs.start)
    except (OSError, ValueError, KeyError):
        return np.nan
