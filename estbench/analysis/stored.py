"""The finished runs of a results folder, as `load` gives them; traces are read when asked for."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from estbench.consistency.fields import Record
from estbench.consistency.statistics import Summary
from estbench.errors import StoreError
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.store.metadata import STORE


@dataclass(frozen=True, eq=False)
class Stored:
    """The finished runs of a store.

    Attributes:
        folder: of the results.
        title: its name beside other stores; the folder's name unless given.
        scenario: as it was run.
        attrs: provenance: seed and versions.
        names, units: of the tangent coordinates `(n,)`.
        channels: their names; empty for a store of an earlier version.
        times: instants `(K + 1,)`, s.
        runs: numbers of the finished runs.
        total: count of runs requested.
        records: label -> per-run and per-step arrays, as `records.merge` gives them.
        samples: label -> the record whose rows vary independently: that of the runs; of a log,
            which is one run, that of its parts (`consistency.parts`).
        summaries: label -> summary.
        tree: the store, lazily read.
        batches: positions of the runs of each finished batch.
        log: of a replay what it is from: files, channels that are held out, whether the truth is
            known; None of simulated runs.
    """

    folder: Path
    title: str
    scenario: Scenario
    attrs: dict[str, Any]
    names: tuple[str, ...]
    units: tuple[str, ...]
    channels: tuple[str, ...]
    times: Array
    runs: NDArray[np.int64]
    total: int
    records: dict[str, Record]
    samples: dict[str, Record]
    summaries: dict[str, Summary]
    tree: xr.DataTree
    batches: tuple[slice, ...]
    log: dict[str, Any] | None = None

    @property
    def has_truth(self) -> bool:
        """Whether the true states are known, at least in part."""
        return self.log is None or bool(self.log["truth"])

    @property
    def origin(self) -> str:
        """Of a replay: the log, and what was not given to the estimators; else empty."""
        if self.log is None:
            return ""
        held = f", {', '.join(self.log['held_out'])} held out" if self.log["held_out"] else ""
        count = len(next(iter(self.samples.values()))["anis"])
        truth = "" if self.has_truth else ", no truth"
        return f"log {', '.join(self.log['files'])}, one run in {count} parts{held}{truth}"

    @property
    def instants(self) -> int:
        """Instants of a run, of which a long one has times for a sample only."""
        return int(self.attrs.get("instants", len(self.times) - 1))

    @property
    def n(self) -> int:
        """Dimension of the tangent space."""
        return len(self.names)

    @property
    def level(self) -> float:
        """Confidence level of bands and intervals."""
        return self.scenario.consistency.level

    @property
    def has_traces(self) -> bool:
        """Whether errors and estimates of each run are stored."""
        return all("error" in self.tree[label] for label in self.records)

    def group(self, label: str) -> xr.Dataset:
        """The arrays of an estimator, lazily read."""
        node = self.tree[label]
        assert isinstance(node, xr.DataTree)
        return node.to_dataset()

    def rank(self, group: xr.Dataset) -> NDArray[np.int64]:
        """Degrees of freedom of NEES at each step of `group`; n in a store of an older version."""
        if "nees_dof" in group:
            return group["nees_dof"].values
        return np.full(group["nees"].shape, self.n)

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Instants that count in averages `(K + 1,)`."""
        return (self.times > self.scenario.consistency.burn_in) & (self.times > 0)

    def traces(self, label: str) -> Iterator[tuple[Array, Array]] | None:
        """Errors `(run, step, n)` and NEES `(run, step)` batch by batch, or None if not stored.

        None of a log too, which is one run.

        Over the settled instants of the runs that did not diverge. The error of a coordinate that
        is known exactly is 0.
        """
        if "error" not in self.tree[label] or self.log is not None:
            return None
        return self._traces(label)

    def _traces(self, label: str) -> Iterator[tuple[Array, Array]]:
        lost = read(self.folder, self.tree, f"{label}/diverged").astype(bool)
        for where in self.batches:
            values = (
                read(self.folder, self.tree, f"{label}/{name}", where)[~lost[where]]
                for name in ("error", "nees", "std")
            )
            error, nees, std = (np.asarray(v[:, self.settled], np.float64) for v in values)
            yield np.where(std == 0, 0.0, error), nees


def array(tree: xr.DataTree, path: str) -> xr.DataArray:
    """An array of a store, lazily read.

    Raises:
        KeyError: there is no such array.
    """
    node = tree[path]
    if not isinstance(node, xr.DataArray):
        raise KeyError(path)
    return node


def read(folder: Path, tree: xr.DataTree, path: str, rows: slice | None = None) -> NDArray[Any]:
    """The values of an array, or of some rows of it.

    Raises:
        StoreError: a chunk is damaged.
        KeyError: there is no such array.
    """
    stored = array(tree, path)
    try:
        return (stored if rows is None else stored[rows]).values
    except (OSError, ValueError, RuntimeError) as error:
        raise StoreError(
            f"{folder / STORE}: {path} cannot be read ({error}); --resume computes it again"
        ) from None
