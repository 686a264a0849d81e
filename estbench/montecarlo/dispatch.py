"""Many batches on many workers: what came of each, and when to give up."""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial

from estbench.consistency.fields import Record
from estbench.errors import ExecutorError, StoreError
from estbench.experiment.setup import Setup
from estbench.montecarlo import worker
from estbench.montecarlo.pool import Failed, Pool, execute
from estbench.store.zarr import Store

Progress = Callable[[int, int], None]
"""Called with the runs done and the runs in all."""


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
        prepared: what is run.
        batches: number -> its runs.
        keep: what is kept of every run.
        using: the workers.
        target: the store, or None.
        done: number -> summary records of the batches already finished; those computed are added.
        progress: called after every batch.

    Returns:
        Number -> summary records, number -> why a batch failed, and whether Ctrl-C came.

    Raises:
        StoreError: the store cannot be written.
        EstbenchError: nothing at all can be computed.
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
    """Raise the error of a batch that says that the others will fail too."""
    if isinstance(error, StoreError) and target is not None:
        runs = sum(len(target.batches[i]) for i in done)
        raise StoreError(
            f"{error} ({runs} of {sum(map(len, target.batches))} runs are finished)"
        ) from None
    # Nothing works: the input is at fault, or the machine, not one batch.
    if not done and (failed > 2 or not isinstance(error, ExecutorError)):
        raise error


def missing(batches: Sequence[range], failed: Mapping[int, Exception]) -> list[str]:
    """What failed and why: a line for batches that follow each other and have the same reason."""
    spans: list[tuple[int, int, str]] = []
    for i, error in sorted(failed.items()):
        runs, reason = batches[i], str(error)
        if spans and spans[-1][1:] == (runs.start, reason):
            spans[-1] = (spans[-1][0], runs.stop, reason)
        else:
            spans.append((runs.start, runs.stop, reason))
    return [f"runs {start}-{stop - 1} are missing: {reason}" for start, stop, reason in spans]
