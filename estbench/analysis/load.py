"""The finished runs of a results folder as records; the store may be unfinished."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from estbench.consistency import parts
from estbench.consistency.fields import Record
from estbench.consistency.parts import summarize_log
from estbench.consistency.records import INNOVATIONS, PARTS, SUMMARY
from estbench.consistency.statistics import Summary
from estbench.consistency.summary import summarize
from estbench.errors import StoreError
from estbench.scenario import load as scenarios
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.store.contents import COSTS, SCENARIO, read_costs
from estbench.store.metadata import INTEGRITY, STORE
from estbench.store.reader import open_results
from estbench.study.store import STUDY

REQUIRED = {"anees", "anis", "mse", "variance", "fault", "fault_step", "diverged"}
"""Variables that every store has; those of older versions may lack the others."""


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
        lost = _read(self.folder, self.tree, f"{label}/diverged").astype(bool)
        for where in self.batches:
            values = (
                _read(self.folder, self.tree, f"{label}/{name}", where)[~lost[where]]
                for name in ("error", "nees", "std")
            )
            error, nees, std = (np.asarray(v[:, self.settled], np.float64) for v in values)
            yield np.where(std == 0, 0.0, error), nees


def load(folder: str | Path, title: str | None = None) -> Stored:
    """Read the finished runs of a results folder; safe while it is still being written.

    Args:
        folder: written by `estbench run`.
        title: its name beside other stores; default the folder's name.

    Raises:
        StoreError: it is no results folder, has no finished run, or a chunk is corrupted.
        ScenarioError: its scenario is not valid.
    """
    folder = Path(folder)
    tree = open_results(folder)
    if not (folder / SCENARIO).is_file():
        raise StoreError(f"{folder} holds no {SCENARIO}; name a folder that `estbench run` wrote")
    try:
        done = _read(folder, tree, "done").astype(bool)
        labels = [str(label) for label in tree.attrs["estimators"]]
        size = int(array(tree, f"{labels[0]}/anees").encoding["chunks"][0])
        names, units = (_read(folder, tree, name) for name in ("coordinate", "unit"))
        _check_present(folder, tree, [s.start // size for s in _whole(done, size)])
        numbers, times = _read(folder, tree, "run"), _read(folder, tree, "time")
        records = {label: _record(folder, tree, label, done, size) for label in labels}
    except (KeyError, IndexError) as error:
        raise StoreError(f"{folder / STORE} is not a store of estbench: no {error}") from None
    if not done.any():
        raise StoreError(f"{folder} has no finished run yet; go on with it by --resume")
    scenario = scenarios.load(folder)
    # A store of an earlier version has no names of channels, and nothing that needs them.
    channels = tuple(map(str, _read(folder, tree, "channel"))) if "channel" in tree else ()
    for label, record in records.items():
        record["cpu_time"] = _cost(folder, tree, label, done, size)
    attrs = {str(key): value for key, value in tree.attrs.items()}
    log = attrs.get("log")
    samples, names, units = records, tuple(map(str, names)), tuple(map(str, units))
    if log is not None:
        both = {label: _sample(folder, tree, label, records[label]) for label in labels}
        samples = {label: sample for label, (sample, _) in both.items()}
        components = tuple(map(str, _read(folder, tree, "reading")))
        summaries = {
            label: summarize_log(
                label, *found, times, scenario.consistency, names, channels, components,
                log["truth"],
            )
            for label, found in both.items()
        }  # fmt: skip
    else:
        summaries = {
            label: summarize(
                label, record, numbers[done].tolist(), times, scenario.consistency, names,
                channels, scenario.contact, instants=attrs.get("instants"),
            )
            for label, record in records.items()
        }  # fmt: skip
    return Stored(
        folder=folder,
        title=title or folder.name,
        scenario=scenario,
        attrs=attrs,
        names=names,
        units=units,
        channels=channels,
        times=times,
        runs=numbers[done],
        total=len(done),
        records=records,
        samples=samples,
        summaries=summaries,
        tree=tree,
        batches=tuple(_whole(done, size)),
        log=log,
    )


def _sample(folder: Path, tree: xr.DataTree, label: str, record: Record) -> tuple[Record, Record]:
    """The parts of a log: all variables, and those of the innovations."""
    arrays = {name: _read(folder, tree, f"{label}/{name}") for name in PARTS | INNOVATIONS}
    return parts.read(arrays, float(record["cpu_time"][0]))


def load_all(folders: Sequence[str | Path]) -> list[Stored]:
    """Read results folders of one robot, with distinct titles.

    Args:
        folders: written by `estbench run`; a folder that holds such folders stands for them.

    Raises:
        StoreError: a folder cannot be read or is named twice, or their states differ.
    """
    paths = [path for folder in folders for path in _stores_in(Path(folder))]
    stores = [load(path, title) for path, title in zip(paths, _titles(paths))]
    first = stores[0]
    for other in stores[1:]:
        if (other.names, other.units) != (first.names, first.units):
            raise StoreError(
                f"{other.folder} estimates {_shown(other.names)} but {first.folder} "
                f"{_shown(first.names)}; read stores of one robot together"
            )
    return stores


def _stores_in(folder: Path) -> list[Path]:
    """The folder itself, or the results folders in it where it holds no store of its own."""
    if (folder / STORE).is_dir() or not folder.is_dir():
        return [folder]
    inside = [path.parent for path in sorted(folder.glob(f"*/{STORE}"))]
    # The store of a sweep has no estimators to compare.
    return [path for path in inside if not (path / STUDY).is_file()] or [folder]


def _titles(folders: Sequence[Path]) -> list[str]:
    """The folders' names, with as many parents as are needed to distinguish them."""
    parts = [folder.resolve().parts for folder in folders]
    if len(set(parts)) < len(parts):
        raise StoreError("a results folder is named twice; name each once")
    depth = 1
    while len({part[-depth:] for part in parts}) < len(parts):
        depth += 1
    return ["/".join(part[-depth:]) for part in parts]


def _shown(names: Sequence[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def _whole(done: NDArray[np.bool_], size: int) -> list[slice]:
    """Positions of the runs of each finished batch."""
    slices = (slice(i, min(i + size, len(done))) for i in range(0, len(done), size))
    return [s for s in slices if done[s].all()]


def _record(
    folder: Path, tree: xr.DataTree, label: str, done: NDArray[np.bool_], size: int
) -> Record:
    """Per-run arrays of the finished runs, per-step sums of the finished batches."""
    batches = [s.start // size for s in _whole(done, size)]
    record: Record = {}
    for name, field in SUMMARY.items():
        if name in REQUIRED or name in tree[label]:  # an older store has fewer
            value = _read(folder, tree, f"{label}/{name}")
            record[name] = value[batches] if field.dims[0] == "batch" else value[done]
    return record


def _check_present(folder: Path, tree: xr.DataTree, batches: Iterable[int]) -> None:
    """Refuse a store without a chunk of a finished batch, which would be read as NaN or 0."""
    if INTEGRITY not in tree.attrs:  # an earlier version wrote no chunk that is all 0
        return
    for group, node in tree.children.items():
        for name, variable in node.data_vars.items():
            within = ["0"] * (variable.ndim - 1)  # in every other dimension it is one chunk
            for batch in batches:
                chunk = folder.joinpath(STORE, group, str(name), "c", str(batch), *within)
                if not chunk.is_file():
                    raise StoreError(f"{chunk} is missing; --resume computes it again")


def _cost(folder: Path, tree: xr.DataTree, label: str, done: NDArray[np.bool_], size: int) -> Array:
    """Core time of each finished run `(run,)`, s, the mean of its batch; NaN if not known."""
    if "cpu_time" in tree[label]:
        return _read(folder, tree, f"{label}/cpu_time")[done]
    cost = np.full(len(done), np.nan)
    for where in _whole(done, size):
        batch = where.start // size
        try:
            total = read_costs(folder, batch)[label]
        except FileNotFoundError:
            if INTEGRITY not in tree.attrs:  # an earlier version may lack them
                continue
            raise StoreError(
                f"{folder / COSTS / f'{batch}.json'} is missing; --resume computes its batch again"
            ) from None
        except (OSError, ValueError, KeyError, TypeError):
            raise StoreError(
                f"{folder / COSTS / f'{batch}.json'} is damaged; --resume computes its batch again"
            ) from None
        cost[where] = total / (where.stop - where.start)
    return cost[done]


def array(tree: xr.DataTree, path: str) -> xr.DataArray:
    """An array of a store, lazily read.

    Raises:
        KeyError: there is no such array.
    """
    node = tree[path]
    if not isinstance(node, xr.DataArray):
        raise KeyError(path)
    return node


def _read(folder: Path, tree: xr.DataTree, path: str, rows: slice | None = None) -> NDArray[Any]:
    stored = array(tree, path)
    try:
        return (stored if rows is None else stored[rows]).values
    except (OSError, ValueError, RuntimeError) as error:
        raise StoreError(
            f"{folder / STORE}: {path} cannot be read ({error}); --resume computes it again"
        ) from None
