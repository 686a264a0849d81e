"""Batches on workers: the outcome of each, and when to give up."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from estbench.consistency.fields import Record
from estbench.errors import ExecutorError, StoreError
from estbench.experiment.setup import Setup, counted
from estbench.montecarlo import worker
from estbench.montecarlo.executors import is_whole
from estbench.montecarlo.pool import Pool, work_off
from estbench.store.zarr import Store

Progress = Callable[[int, int], None]
"""Called with the count of finished runs and that of all runs."""
Say = Callable[[str], None]
"""Called with a notice that the user should read before the runs are computed."""

EXPERIMENTS = itertools.count()
"""Numbers of the experiments of this process."""


def check_shard(shard: tuple[int, int] | None) -> None:
    """Check the number of a share and the count of shares.

    Raises:
        ExecutorError: it is no (i, n) with 1 <= i <= n.
    """
    if shard is None:
        return
    if not (isinstance(shard, tuple | list) and len(shard) == 2 and all(map(is_whole, shard))):
        raise ExecutorError(f"shard is {shard!r}; use (i, n) with 1 <= i <= n")
    if not 1 <= shard[0] <= shard[1]:
        raise ExecutorError(f"shard is {shard[0]}/{shard[1]}; use i/n with 1 <= i <= n")


def check_folder(out: str | Path | None, resume: bool, shard: tuple[int, int] | None) -> None:
    """Check that there is a folder to go on with.

    Raises:
        StoreError: there is none.
    """
    for name, given in (("resume", resume), ("shard", shard is not None)):
        if given and out is None:
            raise StoreError(f"{name} needs the folder that it fills; name it with --out")


def compute(
    prepared: Setup,
    batches: Mapping[int, range],
    keep: str,
    using: Pool,
    target: Store | None,
    done: dict[int, dict[str, Record]],
    progress: Progress | None,
    number: int,
) -> tuple[dict[int, dict[str, Record]], dict[int, Exception], bool]:
    """Compute batches, and write them where there is a store.

    Args:
        prepared: the experiment.
        batches: number of the batch -> its runs.
        keep: `summary`, `diagonal` or `full`.
        using: the workers.
        target: the store, or None.
        done: number -> summary records of the batches already finished; new ones are added.
        progress: called after each batch.
        number: of the experiment; if runs are added to it, workers need not build it again.

    Returns:
        Number -> summary records, number -> error of a failed batch, and whether Ctrl-C came.

    Raises:
        StoreError: the store cannot be written.
        EstbenchError: no batch can be computed.
    """
    toml = counted(prepared, 1).scenario.to_toml()
    count = prepared.scenario.simulation.runs
    folder = None if target is None else str(target.folder.resolve())
    tasks = [
        worker.Task(toml, keep, folder, i, (r.start, r.stop), count, number)
        for i, r in batches.items()
    ]
    failed: dict[int, Exception] = {}
    total, computed = sum(map(len, batches.values())), 0

    def lost(task: worker.Task, error: Exception) -> None:
        failed[task.index] = error
        _give_up(error, target, done, len(failed))

    def finished(task: worker.Task, result: dict[str, Record]) -> None:
        nonlocal computed
        done[task.index] = result
        computed += len(batches[task.index])
        if progress is not None:
            progress(computed, total)

    return done, failed, work_off(worker.work, tasks, using, prepared, finished, lost)


def _give_up(
    error: Exception,
    target: Store | None,
    done: Mapping[int, dict[str, Record]],
    failed: int,
) -> None:
    """Raise the error of a batch if it means that the others will fail too."""
    if isinstance(error, StoreError) and target is not None:
        runs = sum(len(target.batches[i]) for i in done)
        raise StoreError(
            f"{error} ({runs} of {sum(map(len, target.batches))} runs are finished)"
        ) from None
    # No batch succeeds: the cause is the input or the machine, not one batch.
    if not done and (failed > 2 or not isinstance(error, ExecutorError)):
        raise error


def missing(batches: Sequence[range], failed: Mapping[int, Exception]) -> list[str]:
    """Missing runs and the reason: one line for consecutive batches with the same reason."""
    spans: list[tuple[int, int, str]] = []
    for i, error in sorted(failed.items()):
        runs, reason = batches[i], str(error)
        if spans and spans[-1][1:] == (runs.start, reason):
            spans[-1] = (spans[-1][0], runs.stop, reason)
        else:
            spans.append((runs.start, runs.stop, reason))
    return [f"runs {start}-{stop - 1} are missing: {reason}" for start, stop, reason in spans]
