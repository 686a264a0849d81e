"""Running tasks in parallel: threads, processes, or a dask cluster, behind one loop.

The three are the same interface, `concurrent.futures.Executor`. A worker that dies takes the pool
with it: the pool is made anew and what was under way is tried again, one task at a time, so that a
task that kills its worker is found out and reported while the others complete. A task that finds no
memory is tried again in the same way, when no other takes any.
"""

import asyncio
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

from estbench.errors import ExecutorError, MissingExtraError

T = TypeVar("T")
KINDS = ("auto", "threads", "processes", "dask")
TIMEOUT = 10.0
"""Seconds in which a dask scheduler must answer, and have a worker."""
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
        return _dask(address)
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
            while source and len(waiting) < limit:
                task = source.popleft()
                waiting[executor.submit(function, task)] = task
            finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
            lost: dict[T, str] = {}
            broken = False
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


DIED = "the worker died {} times (out of memory? killed?); take fewer --workers"
NO_MEMORY = "no memory, {} times, alone too; take --keep summary, or fewer estimators at once"


def _ours(error: Exception) -> Exception:
    """The error of a task; those of a cluster that lost it, in our words."""
    if isinstance(error, CancelledError):
        return ExecutorError("the cluster was lost before the task was finished; --resume")
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


def _dask(address: str | None) -> Pool:
    if not address:
        raise ExecutorError(
            "executor dask needs the scheduler's address, e.g. tcp://127.0.0.1:8786"
        )
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("dask.distributed", "dask") from None
    client = None
    try:
        asyncio.run(_knock(address))
        client = Client(address, timeout=TIMEOUT, set_as_default=False)
        client.wait_for_workers(1, timeout=TIMEOUT)
    except (OSError, TimeoutError, ValueError) as error:
        what = "scheduler answers" if client is None else "worker is known to the scheduler"
        if client is not None:
            client.close()
        raise ExecutorError(
            f"no dask {what} at {address} within {TIMEOUT:g} s "
            f"({type(error).__name__}); start one or check --address"
        ) from None
    workers = max(1, sum(client.nthreads().values()))

    def close(executor: Executor) -> None:
        executor.shutdown(wait=False)
        client.close()

    return Pool(lambda: client.get_executor(retries=2), workers, close, 2 * workers)


async def _knock(address: str) -> None:
    """Ask the scheduler who it is: a `Client` would wait for ever for one that accepts and is mute.

    Raises:
        OSError, TimeoutError, ValueError: it does not answer in `TIMEOUT`.
    """
    from distributed.core import rpc

    async with rpc(address, timeout=TIMEOUT) as scheduler:
        await asyncio.wait_for(scheduler.identity(), TIMEOUT)
