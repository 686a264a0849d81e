"""The finished runs of a results folder as records; the store may be unfinished."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from estbench.analysis.stored import Stored, array, read
from estbench.consistency import parts
from estbench.consistency.fields import Record
from estbench.consistency.parts import summarize_log
from estbench.consistency.records import INNOVATIONS, PARTS, SUMMARY
from estbench.consistency.summary import summarize
from estbench.errors import StoreError
from estbench.scenario import load as scenarios
from estbench.shapes import Array
from estbench.store.contents import COSTS, SCENARIO, read_costs
from estbench.store.metadata import INTEGRITY, STORE
from estbench.store.reader import open_results
from estbench.study.store import STUDY

REQUIRED = {"anees", "anis", "mse", "variance", "fault", "fault_step", "diverged"}
"""Variables that every store has; those of older versions may lack the others."""


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
        done = read(folder, tree, "done").astype(bool)
        labels = [str(label) for label in tree.attrs["estimators"]]
        size = int(array(tree, f"{labels[0]}/anees").encoding["chunks"][0])
        names, units = (read(folder, tree, name) for name in ("coordinate", "unit"))
        _check_present(folder, tree, [s.start // size for s in _whole(done, size)])
        numbers, times = read(folder, tree, "run"), read(folder, tree, "time")
        records = {label: _record(folder, tree, label, done, size) for label in labels}
    except (KeyError, IndexError) as error:
        raise StoreError(f"{folder / STORE} is not a store of estbench: no {error}") from None
    if not done.any():
        raise StoreError(f"{folder} has no finished run yet; go on with it by --resume")
    scenario = scenarios.load(folder)
    # A store of an earlier version has no names of channels, and nothing that needs them.
    channels = tuple(map(str, read(folder, tree, "channel"))) if "channel" in tree else ()
    for label, record in records.items():
        record["cpu_time"] = _cost(folder, tree, label, done, size)
    attrs = {str(key): value for key, value in tree.attrs.items()}
    log = attrs.get("log")
    samples, names, units = records, tuple(map(str, names)), tuple(map(str, units))
    if log is not None:
        both = {label: _sample(folder, tree, label, records[label]) for label in labels}
        samples = {label: sample for label, (sample, _) in both.items()}
        components = tuple(map(str, read(folder, tree, "reading")))
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
    arrays = {name: read(folder, tree, f"{label}/{name}") for name in PARTS | INNOVATIONS}
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
            value = read(folder, tree, f"{label}/{name}")
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
        return read(folder, tree, f"{label}/cpu_time")[done]
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
