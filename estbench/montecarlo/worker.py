"""One batch of runs on a worker: build the experiment, run the batch, write it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from estbench.consistency.fields import Record
from estbench.consistency.records import COST, SUMMARY
from estbench.experiment.setup import Setup, build, counted
from estbench.montecarlo.batch import run_batch
from estbench.scenario.load import parse
from estbench.store.zarr import Store


@dataclass(frozen=True)
class Task:
    """The task of a worker: small, as it is sent to other processes.

    Attributes:
        toml: the resolved scenario, of any count of runs.
        keep: `summary`, `diagonal` or `full`.
        folder: store to write to, or None.
        index: number of the batch.
        runs: first run and the one after the last.
        count: of the runs of the experiment, which a rule may add to.
        experiment: its number; a process that is kept must not take a model from an earlier one,
            as the file of the robot may have changed.
    """

    toml: str
    keep: str
    folder: str | None
    index: int
    runs: tuple[int, int]
    count: int
    experiment: int


def work(
    task: Task,
    stop: Callable[[], bool] = lambda: False,
    prepared: Setup | None = None,
) -> dict[str, Record] | None:
    """Compute and write a batch; its summary records, or None if `stop` answered True.

    Args:
        task: the batch.
        stop: called at every instant; True ends the batch.
        prepared: the experiment of the task's scenario, if the caller has it in memory.

    Raises:
        EstbenchError: the batch cannot be computed or written.
    """
    prepared = prepared or _prepared(task.toml, task.count, task.experiment)
    runs = range(*task.runs)
    batch = run_batch(prepared, runs, task.keep, stop)
    if batch is None:
        return None
    if task.folder is not None:
        _store(task.folder, prepared).write(task.index, batch.truth, batch.records)
    return {
        label: {name: record[name] for name in SUMMARY | COST}
        for label, record in batch.records.items()
    }


@lru_cache(maxsize=2)
def _built(toml: str, experiment: int) -> Setup:
    return build(parse(toml))


@lru_cache(maxsize=2)
def _prepared(toml: str, count: int, experiment: int) -> Setup:
    return counted(_built(toml, experiment), count)


@lru_cache(maxsize=2)
def _store(folder: str, prepared: Setup) -> Store:
    return Store.reopen(Path(folder), prepared)
