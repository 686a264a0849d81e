"""A store as its readers see it: one tree of labelled arrays."""

import json
import warnings
from pathlib import Path

import xarray as xr

from estbench.errors import StoreError, given_path
from estbench.store import metadata
from estbench.store.metadata import STORE


def open_results(folder: str | Path) -> xr.DataTree:
    """Open the store of a results folder: the root, `truth`, and a group per estimator.

    Raises:
        StoreError: there is no such store, or its metadata or a label is damaged.
    """
    path = given_path("folder", folder, StoreError) / STORE
    if not path.is_dir():
        raise StoreError(f"{folder} holds no {STORE}; name a folder that `estbench run` wrote")
    metadata.check(Path(folder))
    try:
        with warnings.catch_warnings():  # a store that was never closed opens, only slowly
            warnings.filterwarnings("ignore", "Failed to open Zarr store", RuntimeWarning)
            return xr.open_datatree(path, engine="zarr", consolidated=None)
    except (OSError, ValueError, KeyError, json.JSONDecodeError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from None
