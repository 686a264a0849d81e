"""The pools by kind, how many workers fit the machine, and how a pool is abandoned."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

from estbench.errors import ExecutorError
from estbench.montecarlo.pool import Pool

KINDS = ("auto", "threads", "processes", "dask")
LONG = 20_000_000
"""Steps of all runs and estimators, some minutes of one core, from which processes pay."""
PROCESS_BYTES = 250 * 2**20
"""What a process takes before it computes anything."""


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
        from estbench.montecarlo import dask  # takes long to import, and is an extra

        return dask.pool(address)
    raise ExecutorError(f"executor is '{kind}'; use one of {', '.join(KINDS)}")


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
