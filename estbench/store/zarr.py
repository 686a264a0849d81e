"""Results on disk: one zarr store that one `xarray.open_datatree` call opens.

All arrays are declared first. Each batch of runs is one zarr chunk of every array, so that no two
batches write the same file, and `done[run]` is written last. An unfinished store is readable (take
the runs that are done) and can be resumed. A chunk is written to a temporary file and renamed, has
a checksum, and is written even if all its values are the fill value. A batch that is marked done
and lacks a chunk, as after a power failure, is therefore recognized as damaged. All other files
have checksums too (`metadata`, `checksums`).
"""

import contextlib
import errno
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr

from estbench.consistency.fields import Field, Record
from estbench.consistency.records import COST, SUMMARY, TRUTH, fields
from estbench.errors import StoreError
from estbench.experiment.prepared import Setup
from estbench.store import checksums, folders, locks, metadata, resuming, versions
from estbench.store.contents import COSTS, beside, divided, read_costs, stands, unwritable
from estbench.store.metadata import STORE, UNREADABLE
from estbench.store.template import declare, labels, live

NO_MORE: Mapping[str, Any] = {}


class Store:
    """A results folder: `data.zarr`, the resolved `scenario.toml`, and the cost of each batch.

    Made by `create`, or by `reopen` to resume one.

    Attributes:
        folder: its path.
        keep: what is stored of each run: `summary`, `diagonal`, `full` or `log`.
        dtype: of the traces.
        batches: the runs of each batch.
        restored: names of the files that were damaged and that `reopen` wrote again.
    """

    def __init__(
        self, folder: Path, keep: str, dtype: str, batches: Sequence[range], live: bool = False
    ):
        self.folder = folder
        self._live = live
        self.batches = list(batches)
        self.keep = keep
        self.dtype = dtype
        self.restored: list[str] = []
        self._made: list[Path] | None = None
        self._root = self._open("r+")
        self._arrays: dict[str, Any] = {}

    @classmethod
    def create(
        cls,
        folder: Path,
        setup: Setup,
        keep: str,
        batch_size: int,
        dtype: str = "float64",
        more: Mapping[str, Any] = NO_MORE,
    ) -> "Store":
        """Make the folder with an empty store, completely or not at all.

        Args:
            folder: must not exist.
            setup: the experiment.
            keep: `summary`, `diagonal`, `full`, or `log` for a recorded log.
            batch_size: runs per batch, one chunk.
            dtype: of the traces, `float64` or `float32`; averages are always float64.
            more: attributes of the store.

        Raises:
            StoreError: the folder exists or cannot be written.
        """
        batches = divided(setup.scenario.simulation.runs, batch_size)
        made = folders.missing_parents(folder)
        with folders.built(folder) as draft:
            texts = beside(setup)
            for name, text in texts.items():
                (draft / name).write_text(text, encoding="utf-8")
            (draft / COSTS).mkdir()
            root = zarr.open_group(str(draft / STORE), mode="w-", zarr_format=3)
            declare(root, setup, keep, batches, dtype, more)
            metadata.seal(draft, texts, labels(setup, keep))
        new = cls(folder, keep, dtype, batches, live(setup))
        new._made = made
        return new

    @classmethod
    def reopen(
        cls, folder: Path, setup: Setup, keep: str | None = None, dtype: str | None = None
    ) -> "Store":
        """Open a store to resume it; damaged metadata, labels and texts are written again.

        A store of the same scenario with fewer runs is extended; its batches stay as they are.

        Args:
            folder: of the results.
            setup: the experiment.
            keep: what is to be stored of each run; None for what the store has.
            dtype: of the traces, likewise.

        Raises:
            StoreError: it is no store, or of another scenario or level, of which the key that
                differs is named; or a file is damaged that nothing can restore.
        """
        found = resuming.checked(folder, setup, keep, dtype)
        try:
            resuming.extended(folder, setup, found)
            store = cls(folder, found.keep, found.dtype, found.batches, live(setup))
            again = metadata.restore_labels(folder, store._root, found.labels)
        except OSError as error:
            raise unwritable(folder, error) from None
        store.restored = found.restored + [name for name in again if not found.longer]
        return store

    def write(self, batch: int, truth: Record, records: dict[str, Record]) -> None:
        """Write one batch, and mark its runs as done last.

        Raises:
            StoreError: the store was deleted, or the disk is full.
        """
        runs = slice(self.batches[batch].start, self.batches[batch].stop)
        try:
            if not stands(self.folder):
                raise FileNotFoundError(errno.ENOENT, "the store was deleted")
            cost = {label: float(r["cpu_time"].sum()) for label, r in records.items()}
            checksums.write(self.folder / COSTS / f"{batch}.json", cost)
            for group, record in {"truth": truth, **records}.items():
                for name, value in record.items():
                    if name not in COST:
                        array = self._array(f"{group}/{name}")
                        with np.errstate(over="ignore"):  # beyond float32 is infinite
                            kept = value.astype(array.dtype, copy=False)
                        array[self._where(group, name, batch)] = kept
            self._array("done")[runs] = True
        except OSError as error:
            raise unwritable(self.folder, error) from None

    def finished(self, batch: int) -> bool:
        """Whether all runs of the batch are marked as done; False where the mark is corrupted."""
        runs = slice(self.batches[batch].start, self.batches[batch].stop)
        try:
            return bool(np.asarray(self._array("done")[runs]).all())
        except UNREADABLE:
            return False

    def read(self, batch: int, check: bool = True) -> dict[str, Record] | None:
        """The summary records of a finished batch, or None when a chunk is corrupted or missing.

        Args:
            batch: its index.
            check: read the traces too; their checksums are verified as they are read.
        """
        runs = self.batches[batch]
        out: dict[str, Record] = {}
        try:
            groups = [g for g in self._root.group_keys() if g != "truth"]
            for group in sorted(self._root.group_keys()) if check else groups:
                table = self._fields(group)
                names = [name for name in table if check or name in SUMMARY]
                if not all(self._chunk(group, name, batch).is_file() for name in names):
                    return None
                values = {
                    name: np.asarray(
                        self._array(f"{group}/{name}")[self._where(group, name, batch)]
                    )
                    for name in names
                }
                if group != "truth":
                    out[group] = {name: values[name] for name in SUMMARY}
            cost = read_costs(self.folder, batch)
            for group in groups:
                out[group]["cpu_time"] = np.full(len(runs), cost[group] / len(runs))
        except UNREADABLE:
            return None
        return out

    @contextmanager
    def lock(self, shard: locks.Shard | None = None) -> Iterator[None]:
        """Lock the store, or one share of it, and remove what killed writers left.

        Raises:
            StoreError: another process holds it, or the file system cannot lock.
        """
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locks.held(self.folder, shard))
                locks.sweep(self.folder, self.folder / STORE, shard)
            except BlockingIOError:
                raise StoreError(
                    f"another process is writing to {self.folder}; wait for it, or use --shard"
                ) from None
            except OSError as error:
                raise unwritable(self.folder, error) from None
            yield

    def sign(self, writing: bool) -> str | None:
        """A warning if the store's numbers are of several versions, else None.

        Args:
            writing: whether the installed versions are about to write. They are then added to the
                attribute `continued`, unless they are known already.

        Raises:
            StoreError: the store was deleted, or the disk is full.
        """
        try:
            with locks.briefly(self.folder):
                found, now = versions.known(self._open("r").attrs), versions.stamped()
                if writing and now not in found:
                    found.append(now)
                    metadata.change(self.folder, continued=found[1:])
        except OSError as error:
            raise unwritable(self.folder, error) from None
        return versions.mixed(found)

    def discard(self) -> None:
        """Remove the folder and the parents that were made for it, if this object made them."""
        if self._made is not None:
            folders.remove(self.folder, self._made)

    def _open(self, mode: Literal["r", "r+"]) -> zarr.Group:
        return zarr.open_group(str(self.folder / STORE), mode=mode, zarr_format=3)

    def _array(self, path: str) -> Any:
        """An array of the store, cached: opening one reads its metadata."""
        if path not in self._arrays:
            self._arrays[path] = metadata.opened(self._root, path)
        return self._arrays[path]

    def _chunk(self, group: str, name: str, batch: int) -> Path:
        """The file of one batch of an array; in every other dimension the array is one chunk."""
        others = ["0"] * (len(self._fields(group)[name].dims) - 1)
        return self.folder.joinpath(STORE, group, name, "c", str(batch), *others)

    def _fields(self, group: str) -> dict[str, Field]:
        return TRUTH if group == "truth" else fields(self.keep, self._live)

    def _where(self, group: str, name: str, batch: int) -> slice:
        """The rows of an array that belong to a batch."""
        dims = self._fields(group)[name].dims
        runs = self.batches[batch]
        return slice(batch, batch + 1) if dims[0] == "batch" else slice(runs.start, runs.stop)
