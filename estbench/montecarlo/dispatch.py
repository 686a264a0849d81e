"""Batches on workers: the outcome of each, and when to give up."""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial

from estbench.consistency.fields import Record
from estbench.errors import ExecutorError, StoreError
from estbench.experiment.prepared import Setup
from estbench.montecarlo import worker
from estbench.montecarlo.pool import Failed, Pool, execute
from estbench.store.zarr import Store

Progress = Callable[[int, int], None]
"""Called with the count of finished runs and that of all runs."""


def compute(
    prepared: Setup,
    batches: Mapping[int, range],
    keep: str,
    using: Pool,
    target: Store | None,
    done: dict[int, dict[str, Record]],
    progress: Progress | None,
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

    Returns:
        Number -> summary records, number -> error of a failed batch, and whether Ctrl-C came.

    Raises:
        StoreError: the store cannot be written.
        EstbenchError: no batch can be computed.
    """
    toml = prepared.scenario.to_toml()
    folder = None if target is None else str(target.folder.resolve())
    tasks = [worker.Task(toml, keep, folder, i, (r.start, r.stop)) for i, r in batches.items()]
    failed: dict[int, Exception] = {}
    total, finished = sum(map(len, batches.values())), 0
    stopping = threading.Event()
    work = worker.work
    if using.local:
        work = partial(work, stop=stopping.is_set, prepared=prepared)
    try:
        with closing(execute(work, tasks, using, stopping.set)) as outcomes:
            for outcome in outcomes:
                if isinstance(outcome, Failed):
                    failed[outcome.task.index] = outcome.error
                    _give_up(outcome.error, target, done, len(failed))
                    continue
                task, result = outcome
                if result is None:
                    continue
                done[task.index] = result
                finished += len(batches[task.index])
                if progress is not None:
                    progress(finished, total)
    except KeyboardInterrupt:
        return done, failed, True
    return done, failed, False


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
