"""What a results folder holds beside the arrays, and that it cannot be written."""

from pathlib import Path

from estbench.errors import StoreError
from estbench.experiment.prepared import Setup
from estbench.store import checksums, folders
from estbench.store.metadata import STORE

SCENARIO, COSTS = "scenario.toml", "costs"


def divided(runs: int, size: int) -> list[range]:
    """The runs in batches of one size; the last one may be smaller."""
    return [range(i, min(i + size, runs)) for i in range(0, runs, size)]


def read_costs(folder: Path, batch: int) -> dict[str, float]:
    """The core time of each estimator for the runs of a batch, s.

    Raises:
        OSError: there is no such file.
        ValueError, KeyError: it is damaged.
    """
    stored = checksums.read(folder / COSTS / f"{batch}.json")
    if not isinstance(stored, dict):
        raise ValueError("it is no table")
    return {str(label): float(cost) for label, cost in stored.items()}


def beside(setup: Setup) -> dict[str, str]:
    """The texts beside the store."""
    return {SCENARIO: setup.scenario.to_toml()}


def stands(folder: Path) -> bool:
    """Whether the store exists; a write under way may have made its folders again."""
    return (folder / STORE / "zarr.json").is_file()


def unwritable(folder: Path, error: OSError) -> StoreError:
    """The error of a store that cannot be written."""
    if not stands(folder):
        return folders.unwritable(folder, error)
    return StoreError(
        f"{folder} cannot be written: {error.strerror or error}; what is finished is kept there, "
        "free the disk and --resume, or choose another --out"
    )
