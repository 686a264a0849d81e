"""The pools of each kind, and how many workers fit the machine."""

import os
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial

from estbench.errors import ExecutorError
from estbench.experiment.size import free_memory
from estbench.montecarlo import team
from estbench.montecarlo.pool import Pool

KINDS = ("auto", "threads", "processes", "dask")
PROCESS_BYTES = 250 * 2**20
"""Memory of a process before it computes anything."""


def cpu_count() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_count(workers: int | None) -> int:
    """The workers that are wanted, by default one per CPU.

    Raises:
        ExecutorError: it is no whole number of at least 1.
    """
    check_count("workers", workers)
    return workers or cpu_count()


def check_count(name: str, value: object) -> None:
    """Check a count of workers or of runs of a batch; None is left to estbench.

    Raises:
        ExecutorError: it is no whole number of at least 1.
    """
    if value is not None and not (is_whole(value) and value >= 1):  # type: ignore[operator]
        raise ExecutorError(f"{name} is {value!r}; use a whole number of at least 1")


def is_whole(value: object) -> bool:
    """Whether it is a whole number, which True is not."""
    return isinstance(value, int) and not isinstance(value, bool)


def fitting(kind: str, batch: int, cpus: int | None = None, memory: int | None = None) -> int:
    """One worker per CPU, or as many as half of the free memory holds.

    Args:
        kind: `threads`, `processes` or `both`.
        batch: bytes of one batch while it is computed, from `batch.held_bytes`.
        cpus: default those this process may use.
        memory: bytes; default the free memory of the machine or of this process's control group.
    """
    cpus = cpu_count() if cpus is None else cpus
    memory = free_memory() if memory is None else memory
    a_worker = batch + (0 if kind == "threads" else PROCESS_BYTES)
    return cpus if memory is None else max(1, min(cpus, memory // 2 // max(1, a_worker)))


def pool(kind: str, workers: int, address: str | None = None) -> Pool:
    """The pool of a kind: one of `KINDS`, or `both`, this process and spawned ones.

    Raises:
        ExecutorError: the kind is unknown, the free memory does not hold the processes, or the dask
            scheduler does not answer.
        MissingExtraError: dask.distributed is not installed.
    """
    if kind == "threads":
        return Pool(lambda: ThreadPoolExecutor(workers, "estbench"), workers, _leave, 2 * workers)
    if kind in ("processes", "both"):
        _check_memory(workers)
        here = 1 if kind == "both" else 0
        make = partial(team.kept, here, workers - here)
        return Pool(make, workers, team.dismiss, 2 * workers, kept=True)
    if kind == "dask":
        from estbench.montecarlo import dask  # an extra, slow to import

        return dask.pool(address)
    raise ExecutorError(f"executor is '{kind}'; use one of {', '.join(KINDS)}")


def _check_memory(processes: int) -> None:
    """Refuse processes that the free memory does not hold before they compute anything."""
    free = free_memory()
    if free is not None and processes > max(1, most := free // PROCESS_BYTES):
        raise ExecutorError(
            f"workers is {processes}: the free memory ({free / 2**30:.1f} GiB) holds {most} "
            f"processes at most; use fewer --workers, as there are {cpu_count()} CPUs"
        )


def _leave(executor: Executor) -> None:
    executor.shutdown(wait=True, cancel_futures=True)
