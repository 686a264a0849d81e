"""Running tasks in parallel: threads, processes, or a dask cluster, behind one loop.

The three are the same interface, `concurrent.futures.Executor`. A worker that dies takes the pool
with it: the pool is made anew and what was under way is tried again, one task at a time, so that a
task that kills its worker is found out and reported while the others complete. A task that finds no
memory is tried again in the same way, when no other takes any.
"""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from estbench.errors import ExecutorError

T = TypeVar("T")
KINDS = ("auto", "threads", "processes", "dask")
POLL = 1.0
"""Seconds between two looks whether a cluster is still there."""
LONG = 20_000_000
"""Steps of all runs and estimators, some minutes of one core, from which processes pay."""
PROCESS_BYTES = 250 * 2**20
"""What a process takes before it computes anything."""


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
    lost: Callable[[], bool] = lambda: False
    """Whether the workers have gone for good and say nothing of it."""


def cpu_count() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def choose(steps: int, cpus: int) -> str:
    """Threads or processes: what `auto` stands for.

    The interpreter's lock lets threads use few CPUs (the physics and the linear algebra run without
    it, the rest does not), but they start at once; a spawned process takes seconds.

    Args:
        steps: of all runs and estimators together.
        cpus: that there are.
    """
    return "processes" if cpus > 4 and steps >= LONG else "threads"


def fitting(kind: str, batch: int, cpus: int | None = None, memory: int | None = None) -> int:
    """Workers for the CPUs there are, as many as half of the memory holds.

    Args:
        kind: `threads` or `processes`.
        batch: bytes of one batch's traces; computing it takes some three times that.
        cpus: default those this process may use.
        memory: bytes; default what the machine, or this process's control group, has free.
    """
    cpus = cpu_count() if cpus is None else cpus
    memory = free_memory() if memory is None else memory
    a_worker = 3 * batch + (PROCESS_BYTES if kind == "processes" else 0)
    return cpus if memory is None else max(1, min(cpus, memory // 2 // max(1, a_worker)))


def free_memory() -> int | None:
    """Bytes that can be had without swapping, None where the system does not say."""
    found = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        found += [1024 * int(x.split()[1]) for x in lines if x.startswith("MemAvailable")]
    with contextlib.suppress(OSError, ValueError):  # a container's limit; "max" is no number
        group = Path("/sys/fs/cgroup")
        limit, used = (int((group / f"memory.{x}").read_text()) for x in ("max", "current"))
        found.append(limit - used)
    return min(found, default=None)


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
            lambda: ProcessPoolExecutor(workers, context, _start),
            workers,
            _kill,
            workers,
        )
    if kind == "dask":
        from estbench.montecarlo import dask as cluster  # takes long to import, and is an extra

        return cluster.pool(address)
    raise ExecutorError(f"executor is '{kind}'; use one of {', '.join(KINDS)}")


def execute(
    function: Callable[[T], Any],
    tasks: Sequence[T],
    using: Pool,
    stop: Callable[[], None] = lambda: None,
    retries: int = 2,
) -> Generator[tuple[T, Any] | Failed[T], None, None]:
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
    succeeded = False
    executor = using.make()
    try:
        while fresh or suspects or waiting:
            # Suspects run alone, after the others: if one dies again, it is known which. While
            # nothing has succeeded they go first, so that what cannot work ends soon.
            alone = bool(suspects) and not (fresh and succeeded)
            source, limit = (suspects, 1) if alone else (fresh, using.queue)
            broken = False
            while source and len(waiting) < limit and not broken:
                task = source.popleft()
                try:
                    waiting[executor.submit(function, task)] = task
                except BrokenExecutor:  # a worker died meanwhile; this task is no suspect
                    source.appendleft(task)
                    broken = True
                except Exception as error:  # a cluster that was lost takes no more
                    yield Failed(task, ExecutorError(f"{LOST} ({type(error).__name__}: {error})"))
            finished, _ = wait(waiting, POLL, FIRST_COMPLETED) if waiting else ((), ())
            if not finished and using.lost():  # its futures would never be done
                for task in (*waiting.values(), *suspects, *fresh):
                    yield Failed(task, ExecutorError(LOST))
                using.abandon(executor)
                return
            lost: dict[T, str] = {}
            for future in finished:
                task = waiting.pop(future)
                try:
                    result = future.result()
                except BrokenExecutor:
                    broken, lost[task] = True, DIED
                except MemoryError:
                    lost[task] = NO_MEMORY
                except Exception as error:  # what the task raised is its failure
                    yield Failed(task, _ours(error))
                else:
                    succeeded = True
                    yield task, result
            if broken:
                lost |= dict.fromkeys(waiting.values(), DIED)
                waiting.clear()
                using.abandon(executor)
                executor = using.make()
            for task, reason in lost.items():
                deaths[task] += 1
                if deaths[task] <= retries:
                    suspects.append(task)
                else:
                    yield Failed(task, ExecutorError(reason.format(deaths[task])))
    except BaseException:
        stop()
        using.abandon(executor)
        raise
    executor.shutdown(wait=True)
    using.abandon(executor)  # a cluster's connection is left open otherwise


DIED = "the worker died {} times (out of memory? killed?); take fewer --workers"
NO_MEMORY = "no memory, {} times, alone too; take --keep summary, or fewer estimators at once"
LOST = "the cluster was lost; go on with --resume"


def _ours(error: Exception) -> Exception:
    """The error of a task; those of a cluster that lost it, in our words."""
    if isinstance(error, CancelledError):
        return ExecutorError(LOST)
    if type(error).__name__ == "KilledWorker":  # distributed.scheduler.KilledWorker
        return ExecutorError(f"the workers that computed it died: {error}")
    return error


def _leave(executor: Executor) -> None:
    executor.shutdown(wait=True, cancel_futures=True)


def _kill(executor: Executor) -> None:
    """End the processes at once: nothing that they had not finished counts."""
    processes = list((getattr(executor, "_processes", None) or {}).values())
    executor.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        with contextlib.suppress(OSError, ValueError):
            process.kill()


def _start() -> None:
    """What a process does first: leave Ctrl-C to the parent, and not outlive it.

    Ctrl-C reaches every process of the terminal. A parent that is killed can end nobody, and its
    children would wait for work for ever.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_follow, args=(parent.join,), daemon=True).start()


def _follow(parent: Callable[[], None]) -> None:
    parent()
    os._exit(1)
