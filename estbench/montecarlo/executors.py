"""The pools of each kind, and how many workers fit the machine."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor

from estbench.errors import ExecutorError
from estbench.experiment.size import free_memory
from estbench.montecarlo.pool import Pool

KINDS = ("auto", "threads", "processes", "dask")
LONG = 20_000_000
"""Steps of all runs and estimators, some minutes of one core, above which processes are faster."""
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


def choose(steps: int, cpus: int) -> str:
    """The kind that `auto` means: threads or processes.

    Threads start at once but use few CPUs, as only the physics and the linear algebra run without
    the interpreter's lock. A spawned process takes seconds to start.

    Args:
        steps: of all runs and estimators together.
        cpus: available.
    """
    return "processes" if cpus > 4 and steps >= LONG else "threads"


def fitting(kind: str, batch: int, cpus: int | None = None, memory: int | None = None) -> int:
    """One worker per CPU, or as many as half of the free memory holds.

    Args:
        kind: `threads` or `processes`.
        batch: bytes of one batch while it is computed, from `batch.held_bytes`.
        cpus: default those this process may use.
        memory: bytes; default the free memory of the machine or of this process's control group.
    """
    cpus = cpu_count() if cpus is None else cpus
    memory = free_memory() if memory is None else memory
    a_worker = batch + (PROCESS_BYTES if kind == "processes" else 0)
    return cpus if memory is None else max(1, min(cpus, memory // 2 // max(1, a_worker)))


def pool(kind: str, workers: int, address: str | None = None) -> Pool:
    """The pool of a kind.

    Raises:
        ExecutorError: the kind is unknown, or the dask scheduler does not answer.
        MissingExtraError: dask.distributed is not installed.
    """
    if kind == "threads":
        return Pool(
            lambda: ThreadPoolExecutor(workers, "estbench"), workers, _leave, 2 * workers, True
        )
    if kind == "processes":
        context = multiprocessing.get_context("spawn")
        return Pool(
            lambda: ProcessPoolExecutor(workers, context, _start),
            workers,
            _kill,
            workers,
        )
    if kind == "dask":
        from estbench.montecarlo import dask  # an extra, slow to import

        return dask.pool(address)
    raise ExecutorError(f"executor is '{kind}'; use one of {', '.join(KINDS)}")


def _leave(executor: Executor) -> None:
    executor.shutdown(wait=True, cancel_futures=True)


def _kill(executor: Executor) -> None:
    """Kill the processes; their unfinished tasks give no result."""
    processes = list((getattr(executor, "_processes", None) or {}).values())
    executor.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        with contextlib.suppress(OSError, ValueError):
            process.kill()


def _start() -> None:
    """Initialize a process: it ignores Ctrl-C and exits when its parent dies.

    Ctrl-C reaches every process of the terminal, and the parent handles it. A parent that is killed
    cannot end its children, which would wait for tasks without end.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_follow, args=(parent.join,), daemon=True).start()


def _follow(parent: Callable[[], None]) -> None:
    parent()
    os._exit(1)
