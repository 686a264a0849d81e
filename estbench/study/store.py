"""The store of a study: one zarr group whose variables have the varied keys as dimensions.

A chunk is one group of variants, which share their truth, and one batch of runs. So two pieces
never write one file, and a study that was killed is gone on with piece by piece: `done` of a piece
is written last. The scenario and the varied keys stand beside it.
"""

import contextlib
import json
import os
import tomllib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec

from estbench.consistency.fields import Record
from estbench.errors import StoreError, given_path
from estbench.scenario.load import changes
from estbench.store import checksums, extension, folders, locks, metadata
from estbench.store.contents import SCENARIO, divided
from estbench.store.metadata import STORE
from estbench.store.template import provenance
from estbench.study.compute import Outcomes, Piece
from estbench.study.design import Study
from estbench.study.evaluation import KEPT, failed

STUDY, FAILURES = "study.json", "failures"


class StudyStore:
    """The results folder of a study.

    Made by `create`, or by `reopen` to resume one.

    Attributes:
        folder: its path.
        batches: the runs of each batch.
        restored: names of the files that were damaged and that `reopen` wrote again.
    """

    def __init__(self, folder: Path, study: Study, sizes: Mapping[str, int], batch_size: int):
        self.folder, self._study, self._sizes = folder, study, dict(sizes)
        self.batches = divided(study.scenario.simulation.runs, batch_size)
        self.restored: list[str] = []
        self._root = zarr.open_group(str(folder / STORE), mode="r+", zarr_format=3)
        self._arrays = {name: metadata.opened(self._root, name) for name in (*KEPT, "done")}

    @classmethod
    def create(
        cls,
        folder: Path,
        study: Study,
        sizes: Mapping[str, int],
        coordinates: Mapping[str, Sequence[str]],
        batch_size: int,
    ) -> "StudyStore":
        """Make the folder with an empty store, completely or not at all.

        Raises:
            StoreError: the folder exists or cannot be written.
        """
        with folders.built(folder) as draft:
            texts = _texts(study, sizes, batch_size)
            for name, text in texts.items():
                (draft / name).write_text(text, encoding="utf-8")
            (draft / FAILURES).mkdir()
            _declare(draft / STORE, study, sizes, coordinates, batch_size)
            metadata.seal(draft, texts, _labels(study, coordinates))
        return cls(folder, study, sizes, batch_size)

    @classmethod
    def reopen(
        cls,
        folder: Path,
        study: Study,
        sizes: Mapping[str, int],
        coordinates: Mapping[str, Sequence[str]],
        batch_size: int,
    ) -> "StudyStore":
        """Open a store to go on with it; damaged metadata, labels and texts are written again.

        A store of the same study with fewer runs is extended.

        Args:
            folder: of the results.
            study: the variants.
            sizes: length of each dimension.
            coordinates: dimension -> names along it.
            batch_size: runs per batch, for a store whose metadata does not tell.

        Raises:
            StoreError: it is no store, or of another study, or a file is damaged that nothing can
                restore.
        """
        batch_size = metadata.rows(folder, "done") or batch_size
        restored = metadata.restore(folder, _texts(study, sizes, batch_size))
        about, asked = read_about(folder), json.loads(json.dumps(describe(study)))
        before, now = (tomllib.loads(x.get("scenario", "")) for x in (about, asked))
        differences = changes(before, now)
        longer = extension.is_longer(differences)
        if (differences and not longer) or any(about.get(k) != asked[k] for k in ("axes", "grid")):
            raise StoreError(
                f"{folder} is of another study: its keys, values or scenario differ; choose "
                "another --out"
            )
        sizes, batch_size = about["sizes"], int(about["batch_size"])
        names = _labels(study, coordinates)
        if longer:
            lengths = {"run": study.scenario.simulation.runs}
            extension.extend(folder, _texts(study, sizes, batch_size), names, lengths)
        store = cls(folder, study, sizes, batch_size)
        again = metadata.restore_labels(folder, store._root, names)
        store.restored = restored + [name for name in again if not longer]
        return store

    @contextmanager
    def lock(self, shard: locks.Shard | None = None) -> Iterator[None]:
        """Lock the store, or one share of it.

        Raises:
            StoreError: another process holds it.
        """
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locks.held(self.folder, shard))
            except BlockingIOError:
                raise StoreError(
                    f"another process is writing to {self.folder}; wait for it, or use --shard"
                ) from None
            yield

    def write(self, piece: Piece, outcomes: Outcomes) -> None:
        """Write one piece, and mark it as done last.

        Raises:
            StoreError: the store was deleted, or the disk is full.
        """
        group, batch = piece
        runs = self.batches[batch]
        where = self._where(piece)
        labels = self._study.labels
        shape = (*self._study.groups[group].shape, len(labels))
        try:
            reasons = [
                [i, label, o]
                for i, by_label in enumerate(outcomes)
                for label, o in by_label.items()
                if isinstance(o, str)
            ]
            if reasons:
                checksums.write(self._failure_file(piece), reasons)
            blank = failed(self._sizes, len(runs))
            rows = [
                blank if isinstance(o := by_label[label], str) else o
                for by_label in outcomes
                for label in labels
            ]
            for name in KEPT:
                stacked = np.stack([row[name] for row in rows])
                self._arrays[name][where] = stacked.reshape(*shape, *stacked.shape[1:])
            self._arrays["done"][where] = np.ones((*shape, len(runs)), dtype=bool)
        except OSError as error:
            raise StoreError(
                f"{self.folder} cannot be written: {error.strerror or error}; what is finished is "
                "kept there, free the disk and --resume"
            ) from None

    def finished(self, piece: Piece) -> bool:
        """Whether a piece is marked as done and can be read."""
        try:
            return bool(np.asarray(self._arrays["done"][self._where(piece)]).all())
        except (OSError, ValueError, RuntimeError):
            return False

    def read(self, piece: Piece) -> Outcomes | None:
        """A finished piece; None where a chunk of it is damaged."""
        where, labels = self._where(piece), self._study.labels
        count = self._study.groups[piece[0]].size
        try:
            found = {
                name: np.asarray(self._arrays[name][where]).reshape(
                    count, len(labels), len(self.batches[piece[1]]),
                    *(self._sizes[d] for d in KEPT[name].dims[1:]),
                )
                for name in KEPT
            }  # fmt: skip
            file = self._failure_file(piece)
            reasons = checksums.read(file) if file.is_file() else []
        except metadata.UNREADABLE:
            return None
        out: list[dict[str, Record | str]] = [
            {label: {n: v[i, j] for n, v in found.items()} for j, label in enumerate(labels)}
            for i in range(count)
        ]
        for i, label, reason in reasons:
            out[i][label] = reason
        return out

    def _failure_file(self, piece: Piece) -> Path:
        return self.folder / FAILURES / f"{piece[0]}-{piece[1]}.json"

    def _where(self, piece: Piece) -> tuple[slice, ...]:
        """The block of a piece in every array."""
        group = self._study.groups[piece[0]]
        start = np.unravel_index(int(group.flat[0]), self._study.shape)
        block = tuple(slice(int(a), int(a) + n) for a, n in zip(start, group.shape))
        runs = self.batches[piece[1]]
        return (*block, slice(None), slice(runs.start, runs.stop))


def describe(study: Study) -> dict[str, Any]:
    """What makes two studies the same."""
    return {
        "axes": [{"key": list(a.names), "values": list(a.values)} for a in study.axes],
        "grid": study.grid,
        "scenario": study.scenario.to_toml(),
    }


def read_about(folder: Path) -> dict[str, Any]:
    """The description of the study in a folder.

    Raises:
        StoreError: there is none.
    """
    try:
        return json.loads((folder / STUDY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise StoreError(
            f"{folder} holds no {STUDY}; name a folder that `estbench sweep` wrote"
        ) from None


def open_study(folder: str | os.PathLike[str]) -> xr.Dataset:
    """Open the store of a study: variables (varied keys, estimator, run, ...).

    Raises:
        StoreError: there is no such store, or its metadata or a label is damaged.
    """
    path = given_path("folder", folder, StoreError)
    metadata.check(path)
    read_about(path)
    with warnings.catch_warnings():  # a store that was never closed opens, only slowly
        warnings.filterwarnings("ignore", "Failed to open Zarr store", RuntimeWarning)
        return xr.open_zarr(path / STORE, consolidated=None)


def _texts(study: Study, sizes: Mapping[str, int], batch_size: int) -> dict[str, str]:
    """The texts beside the store."""
    about = describe(study) | {"batch_size": batch_size, "sizes": dict(sizes)}
    return {SCENARIO: study.scenario.to_toml(), STUDY: json.dumps(about, indent=1)}


def coordinate(values: Sequence[Any]) -> NDArray[Any]:
    """The values of a key as a coordinate: numbers, or their text."""
    numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return np.array(values, float) if numeric else np.array([str(v) for v in values], object)


def _labels(study: Study, coordinates: Mapping[str, Sequence[str]]) -> metadata.Labels:
    """The names of rows and columns of a store."""
    labels: dict[str, tuple[str, NDArray[Any]]] = {
        "estimator": ("estimator", coordinate(study.labels)),
        **{name: (name, coordinate(values)) for name, values in coordinates.items()},
        "run": ("run", np.arange(study.scenario.simulation.runs)),
    }
    for axis in study.axes:
        labels[axis.key] = (axis.key if study.grid else study.dims[0], coordinate(axis.values))
    return labels


def _declare(
    path: Path,
    study: Study,
    sizes: Mapping[str, int],
    coordinates: Mapping[str, Sequence[str]],
    batch_size: int,
) -> None:
    """Declare every array: one chunk per group of variants and batch of runs."""
    root = zarr.open_group(str(path), mode="w-", zarr_format=3)
    root.attrs.update(provenance(study.scenario))
    lengths = {**sizes, "run": study.scenario.simulation.runs}
    metadata.write_labels(root, _labels(study, coordinates))
    block = study.groups[0].shape
    head = (*study.dims, "estimator")
    for name in (*KEPT, "done"):
        field = KEPT.get(name)
        tail = ("run",) if field is None else field.dims
        inner = tuple(lengths[d] for d in tail[1:])
        array = root.create_array(
            name,
            shape=(*study.shape, len(study.labels), lengths["run"], *inner),
            chunks=(*block, len(study.labels), batch_size, *inner),
            dtype="bool" if field is None else field.dtype.replace("?", "bool"),
            dimension_names=(*head, *tail),
            fill_value=np.nan if field is not None and field.dtype.startswith("f") else 0,
            compressors=Crc32cCodec(),
        )
        if field is not None:
            array.attrs["meaning"] = field.meaning
