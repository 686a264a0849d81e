"""Running tasks in parallel: threads, processes, or a dask cluster, behind one loop.

The three are the same interface, `concurrent.futures.Executor`. A worker that dies takes the pool
with it: the pool is made anew and what was under way is tried again, one task at a time, so that a
task that kills its worker is found out and reported while the others complete.
"""

import contextlib
import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from estbench.errors import ExecutorError, MissingExtraError

T = TypeVar("T")
KINDS = ("threads", "processes", "dask")
TIMEOUT = 15.0
"""Seconds in which a dask scheduler must answer."""


@dataclass(frozen=True)
class Failed(Generic[T]):
    """A task that gave no result, and why."""

    task: T
    error: Exception


@dataclass(frozen=True)
class Pool:
    """How to make an executor, how many tasks it works on at once, and how to abandon it."""

    make: Callable[[], Executor]
    workers: int
    abandon: Callable[[Executor], None]
    queue: int
    """Tasks handed over at once; with processes only those under way, so that a death has few
    suspects."""
    local: bool = False
    """Whether tasks share this process's memory."""


def cpu_count() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def pool(kind: str, workers: int, address: str | None = None) -> Pool:
    """The pool of a kind.

    Raises:
        ExecutorError: unknown kind, or a dask scheduler that cannot be reached.
        MissingExtraError: dask.distributed is not installed.
    """
    if kind == "threads":
        return Pool(
            lambda: ThreadPoolExecutor(workers, "estbench"), workers, _leave, 2 * workers, True
        )
    if kind == "processes":
        context = multiprocessing.get_context("spawn")
        return Pool(
            lambda: ProcessPoolExecutor(workers, context, _ignore_interrupt),
            workers,
            _kill,
            workers,
        )
    if kind == "dask":
        return _dask(address)
    raise ExecutorError(f"executor is '{kind}'; use one of {', '.join(KINDS)}")


def execute(
    function: Callable[[T], Any],
    tasks: Sequence[T],
    using: Pool,
    stop: Callable[[], None] = lambda: None,
    retries: int = 2,
) -> Iterator[tuple[T, Any] | Failed[T]]:
    """Results as they come, in any order; a task that raised or whose worker died is `Failed`.

    Args:
        function: called with each task; for processes it must be importable.
        tasks: hashable.
        using: from `pool`.
        stop: called when the loop is left early, before the executor is abandoned.
        retries: how often a task whose worker died is tried again, alone.
    """
    fresh, suspects = deque(tasks), deque[T]()
    deaths: Counter[T] = Counter()
    waiting: dict[Future[Any], T] = {}
    executor = using.make()
    try:
        while fresh or suspects or waiting:
            # Suspects run alone, after the others: if one dies again, it is known which.
            alone = bool(suspects) and not fresh
            source, limit = (suspects, 1) if alone else (fresh, using.queue)
            while source and len(waiting) < limit:
                task = source.popleft()
                waiting[executor.submit(function, task)] = task
            finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
            lost = []
            for future in finished:
                task = waiting.pop(future)
                try:
                    yield task, future.result()
                except BrokenExecutor:
                    lost.append(task)
                except Exception as error:  # whatever the task raised is the task's failure
                    yield Failed(task, error)
            if lost:
                lost += waiting.values()
                waiting.clear()
                using.abandon(executor)
                executor = using.make()
                for task in lost:
                    deaths[task] += 1
                    if deaths[task] <= retries:
                        suspects.append(task)
                    else:
                        yield Failed(task, ExecutorError(
                            f"the worker died {deaths[task]} times (out of memory? killed?)"
                        ))  # fmt: skip
    except BaseException:
        stop()
        using.abandon(executor)
        raise
    executor.shutdown(wait=True)


def _leave(executor: Executor) -> None:
    executor.shutdown(wait=True, cancel_futures=True)


def _kill(executor: Executor) -> None:
    """End the processes at once: nothing that they had not finished counts."""
    processes = list((getattr(executor, "_processes", None) or {}).values())
    executor.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        with contextlib.suppress(OSError, ValueError):
            process.kill()


def _ignore_interrupt() -> None:
    """Ctrl-C reaches every process of the terminal; only the parent answers it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _dask(address: str | None) -> Pool:
    if not address:
        raise ExecutorError(
            "executor dask needs the scheduler's address, e.g. tcp://127.0.0.1:8786"
        )
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("dask.distributed", "dask") from None
    try:
        client = Client(address, timeout=TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ExecutorError(
            f"no dask scheduler answers at {address} within {TIMEOUT:g} s "
            f"({type(error).__name__}); start one or check --address"
        ) from None
    workers = max(1, sum(client.nthreads().values()))

    def close(executor: Executor) -> None:
        executor.shutdown(wait=False)
        client.close()

    return Pool(lambda: client.get_executor(retries=2), workers, close, 2 * workers)
