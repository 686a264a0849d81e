"""A store that is gone on with: it must be of the same experiment, of as many runs or fewer."""

import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import zarr

from estbench.consistency.records import fields
from estbench.errors import StoreError
from estbench.experiment.prepared import Setup
from estbench.scenario.load import changes
from estbench.store import extension, metadata
from estbench.store.contents import SCENARIO, beside, divided, unwritable
from estbench.store.metadata import STORE
from estbench.store.template import labels, live


@dataclass(frozen=True)
class Resumed:
    """What a store holds that can be gone on with.

    Attributes:
        keep: what is stored of each run.
        dtype: of the traces.
        batches: the runs of each batch.
        labels: the names of rows and columns that it is to have.
        longer: whether it is to have more runs than it has.
        restored: names of the texts and metadata that were damaged and are written again.
    """

    keep: str
    dtype: str
    batches: list[range]
    labels: metadata.Labels
    longer: bool
    restored: list[str]


def checked(folder: Path, setup: Setup, keep: str | None, dtype: str | None) -> Resumed:
    """See `Store.reopen`; damaged metadata and texts are written again.

    Raises:
        StoreError: as of `Store.reopen`.
    """
    if not (folder / STORE).is_dir():
        raise StoreError(f"{folder} holds no {STORE}; there is nothing to resume")
    texts = beside(setup)
    try:
        restored = metadata.restore(folder, texts)
    except OSError as error:
        raise unwritable(folder, error) from None
    longer = _longer(folder, texts[SCENARIO])
    try:
        root = zarr.open_group(str(folder / STORE), mode="r", zarr_format=3)
        attrs = root.attrs.asdict()
        size, kept = int(attrs["batch_size"]), (str(attrs["keep"]), str(attrs["dtype"]))  # type: ignore[arg-type]
    except (OSError, KeyError, ValueError, json.JSONDecodeError) as error:
        raise StoreError(f"{folder / STORE} cannot be read: {error}") from None
    for name, was, asked in zip(("keep", "dtype"), kept, (keep, dtype)):
        if asked not in (None, was):
            raise StoreError(
                f"{folder} is of another experiment: {name} was {was!r} and is {asked!r}; "
                "choose another --out"
            )
    names = labels(setup, kept[0])
    wanted = [f"{e}/{f}" for e in setup.scenario.estimators for f in fields(kept[0], live(setup))]
    _refuse_other_arrays(folder, root, wanted, names)
    batches = divided(setup.scenario.simulation.runs, size)
    return Resumed(*kept, batches, names, longer, restored)


def extended(folder: Path, setup: Setup, found: Resumed) -> None:
    """Declare the arrays longer, where there are to be more runs.

    Raises:
        StoreError: another process is writing to it, or it takes no more runs.
        OSError: the folder cannot be written.
    """
    if found.longer:
        lengths = {"run": setup.scenario.simulation.runs, "batch": len(found.batches)}
        extension.extend(folder, beside(setup), found.labels, lengths)


def extent(folder: Path) -> tuple[int, int]:
    """How many runs a store has, finished or not, and how many a batch.

    Raises:
        StoreError: it is no store, or its metadata is damaged.
    """
    try:
        root = zarr.open_group(str(folder / STORE), mode="r", zarr_format=3)
        return int(root["done"].shape[0]), int(root.attrs["batch_size"])  # type: ignore[arg-type]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise StoreError(f"{folder} cannot be continued: {error}; choose another --out") from None


def _longer(folder: Path, asked: str) -> bool:
    """Whether a scenario differs from that of the store by more runs alone; False if by nothing."""
    try:
        before = tomllib.loads((folder / SCENARIO).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StoreError(
            f"{folder / SCENARIO} cannot be read: {error}; choose another --out"
        ) from None
    differences = changes(before, tomllib.loads(asked))
    if not differences or extension.is_longer(differences):
        return bool(differences)
    key, was, now = next((d for d in differences if d[0] == "name"), differences[0])
    if [key for key, *_ in differences] == ["simulation.runs"]:
        raise StoreError(
            f"{folder} has {was} runs and {now} are asked for: runs are added, not taken away; "
            f"use --runs {was} or more, or choose another --out"
        )
    raise StoreError(
        f"{folder} is of another scenario: {key} was {was!r} and is {now!r}; choose another --out"
    )


def _refuse_other_arrays(
    folder: Path, root: zarr.Group, wanted: Sequence[str], names: metadata.Labels
) -> None:
    """Refuse a store whose arrays another version of estbench has declared."""
    if lacking := [path for path in wanted if path not in root]:
        raise StoreError(
            f"{folder} was begun with an earlier version of estbench and has no {lacking[0]}: it "
            "can be read but not continued; choose another --out"
        )
    if metadata.opened(root, "time").shape != names["time"][1].shape:
        raise StoreError(
            f"{folder} was begun with another version of estbench, which keeps sums of other "
            "instants: it can be read but not continued; choose another --out"
        )
