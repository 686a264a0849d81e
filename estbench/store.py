"""Results on disk: one zarr store that one `xarray.open_datatree` call opens.

The parent writes the template first; a batch of runs is one zarr chunk, so batches never write the
same file; `done[run]` is set last. An unfinished store is readable: take the runs that are done.
"""

import contextlib
import json
import platform
import re
import shutil
import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from estbench.errors import StoreError
from estbench.records import TRUTH, Field, Record, fields
from estbench.scenario import Scenario
from estbench.setup import Setup

STORE, SCENARIO = "data.zarr", "scenario.toml"


def default_folder(name: str) -> Path:
    """`results/<scenario>-<time>`, the time in UTC to the second."""
    safe = re.sub(r"[^\w.-]+", "_", name).strip("._")
    return Path("results") / f"{safe}-{datetime.now(UTC):%Y%m%dT%H%M%S}"


class Store:
    """A results folder being written: `data.zarr` and the resolved `scenario.toml`.

    Args:
        folder: must not exist.
        setup: what is run.
        keep: `summary`, `diagonal` or `full`.
        batches: runs of each batch.

    Raises:
        StoreError: the folder exists or cannot be written.
    """

    def __init__(self, folder: Path, setup: Setup, keep: str, batches: Sequence[Sequence[int]]):
        self.folder = folder
        self._keep = keep
        self._made = [path for path in folder.parents if not path.exists()]
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise StoreError(f"{folder} exists; choose another --out or remove it") from None
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            (folder / SCENARIO).write_text(setup.scenario.to_toml(), encoding="utf-8")
            self._root = zarr.open_group(str(folder / STORE), mode="w-", zarr_format=3)
            self._template(setup, batches)
        except OSError as error:
            self.discard()
            raise self._unwritable(error) from None
        except BaseException:  # Ctrl-C, or anything else: an empty template is of no use
            self.discard()
            raise

    def write(self, batch: int, runs: slice, truth: Record, records: dict[str, Record]) -> None:
        """Write one batch and mark its runs done.

        Raises:
            StoreError: the disk is full or gone.
        """
        try:
            for group, record in {"truth": truth, **records}.items():
                for name, value in record.items():
                    array = self._root[f"{group}/{name}"]
                    where = (
                        slice(batch, batch + 1) if self._dims(group, name)[0] == "batch" else runs
                    )
                    array[where] = value  # type: ignore[index]
            self._root["done"][runs] = True  # type: ignore[index]
        except OSError as error:
            raise self._unwritable(error) from None

    def close(self) -> None:
        """Consolidate the metadata, so that opening reads one file."""
        with warnings.catch_warnings():  # zarr warns that consolidation is not yet in the standard
            warnings.simplefilter("ignore", UserWarning)
            zarr.consolidate_metadata(str(self.folder / STORE))

    def discard(self) -> None:
        """Remove the folder, and the parents made for it: nothing in it was finished."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self.folder)
            for parent in self._made:
                parent.rmdir()  # refused, and so kept, if something else lies in it

    def _unwritable(self, error: OSError) -> StoreError:
        return StoreError(
            f"{self.folder} cannot be written: {error.strerror or error}; choose another --out"
        )

    def _dims(self, group: str, name: str) -> tuple[str, ...]:
        return (TRUTH if group == "truth" else fields(self._keep))[name].dims

    def _template(self, setup: Setup, batches: Sequence[Sequence[int]]) -> None:
        runs = [run for batch in batches for run in batch]
        space = setup.space
        sizes = {
            "run": len(runs),
            "time": len(setup.times),
            "batch": len(batches),
            "coordinate": space.n,
            "coordinate_": space.n,
            "state": space.nx,
        }
        chunk = {**sizes, "run": max(len(b) for b in batches), "batch": 1}
        self._root.attrs.update(provenance(setup.scenario))
        coordinates: dict[str, Any] = {
            "run": np.array(runs),
            "time": setup.times,
        }
        for name, value in coordinates.items():
            self._root.create_array(name, data=value, dimension_names=(name,))
        self._root["time"].attrs["units"] = "s"
        self._labels("coordinate", ("coordinate",), space.names)
        self._labels("coordinate_", ("coordinate_",), space.names)
        self._labels("unit", ("coordinate",), space.units)
        done = self._root.create_array(
            "done", shape=(len(runs),), chunks=(chunk["run"],), dtype="?", dimension_names=("run",),
            fill_value=False,
        )  # fmt: skip
        done.attrs["meaning"] = "the run is complete; ignore the others"

        def declare(group: str, table: dict[str, Field]) -> None:
            for name, field in table.items():
                array = self._root.create_array(
                    f"{group}/{name}",
                    shape=tuple(sizes[d] for d in field.dims),
                    chunks=tuple(chunk[d] for d in field.dims),
                    dtype=field.dtype,
                    dimension_names=field.dims,
                    fill_value=np.nan if field.dtype.startswith("f") else 0,
                    compressors=None,  # noise does not compress
                )
                array.attrs["meaning"] = field.meaning

        for label in setup.scenario.estimators:
            declare(label, fields(self._keep))
        if self._keep != "summary":
            declare("truth", TRUTH)

    def _labels(self, name: str, dims: tuple[str, ...], values: Sequence[str]) -> None:
        """Strings of variable length: the only ones that zarr 3 has a specification for."""
        array = self._root.create_array(
            name,
            shape=(len(values),),
            dtype=str,
            dimension_names=dims,  # type: ignore[arg-type]
        )
        array[:] = np.array(values, dtype=object)


def provenance(scenario: Scenario) -> dict[str, Any]:
    """Versions, seed and time of a run, as attributes."""
    packages = ("estbench", "mujoco", "numpy", "scipy", "zarr", "xarray")
    return {
        "scenario": scenario.name,
        "seed": scenario.simulation.seed,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {name: version(name) for name in packages}
        | {"python": platform.python_version()},
        "estimators": list(scenario.estimators),
    }


def open_results(folder: str | Path) -> xr.DataTree:
    """Open the store of a results folder: the root, `truth`, and a group per estimator.

    Raises:
        StoreError: there is no such store.
    """
    path = Path(folder) / STORE
    if not path.is_dir():
        raise StoreError(f"{folder} holds no {STORE}; name a folder that `estbench run` wrote")
    try:
        with warnings.catch_warnings():  # a store that was never closed opens slowly: no matter
            warnings.filterwarnings("ignore", "Failed to open Zarr store", RuntimeWarning)
            return xr.open_datatree(path, engine="zarr", consolidated=None)
    except (OSError, ValueError, KeyError, json.JSONDecodeError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from None
