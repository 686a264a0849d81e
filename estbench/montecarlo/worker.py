"""One batch of runs, wherever it is computed: build what it needs, run it, write it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from estbench.consistency.fields import Record
from estbench.consistency.records import COST, SUMMARY
from estbench.experiment.setup import Setup, build
from estbench.montecarlo.batch import run_batch
from estbench.robots.batch import engine
from estbench.scenario.load import parse
from estbench.store.zarr import Store


@dataclass(frozen=True)
class Task:
    """What a worker is told; small, so that it travels.

    Attributes:
        toml: the resolved scenario.
        keep: `summary`, `diagonal` or `full`.
        folder: store to write to, or None.
        index: of the batch.
        runs: first run and the one after the last.
    """

    toml: str
    keep: str
    folder: str | None
    index: int
    runs: tuple[int, int]


def work(
    task: Task,
    stop: Callable[[], bool] = lambda: False,
    prepared: Setup | None = None,
) -> dict[str, Record] | None:
    """Compute and write a batch; its summary records, or None when `stop` answered True.

    Args:
        task: what to do.
        stop: asked at every instant.
        prepared: what the task's scenario stands for, where the caller shares its memory.

    Raises:
        EstbenchError: the batch cannot be computed or written.
    """
    prepared = prepared or _prepared(task.toml)
    runs = range(*task.runs)
    with engine():
        batch = run_batch(prepared, runs, task.keep, stop)
    if batch is None:
        return None
    if task.folder is not None:
        _store(task.folder, task.toml).write(task.index, batch.truth, batch.records)
    return {
        label: {name: record[name] for name in SUMMARY | COST}
        for label, record in batch.records.items()
    }


@lru_cache(maxsize=2)
def _prepared(toml: str) -> Setup:
    return build(parse(toml))


@lru_cache(maxsize=2)
def _store(folder: str, toml: str) -> Store:
    return Store.reopen(Path(folder), _prepared(toml))
