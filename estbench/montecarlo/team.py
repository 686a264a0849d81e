"""An executor of threads of this process and of spawned processes, kept for all its batches.

Each spawned process belongs to one thread, which hands it one task after the other and takes none
before the process has started: meanwhile the others compute. So the death of a process is that of
one known task, and a process that cannot start holds nothing up.
"""

import contextlib
import multiprocessing
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from estbench.spaces.blas import one_thread

Job = tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]


class WorkerDiedError(Exception):
    """The process of a task ended before the task."""


class Team(Executor):
    """Workers that serve one queue.

    Args:
        here: tasks that this process computes at once.
        spawned: processes, which start in the background.
    """

    def __init__(self, here: int, spawned: int):
        self.size, self.sources = (here, spawned), sources()
        self.closed = False
        self._here = here
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._processes: set[ProcessPoolExecutor] = set()
        self._threads = [
            threading.Thread(target=serve, name="estbench", daemon=True)
            for serve in (*here * [self._compute], *spawned * [self._hand_over])
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **_: Any) -> Future[Any]:
        """Append a task to the queue."""
        if self.closed:
            raise RuntimeError("the workers have been dismissed")
        future: Future[Any] = Future()
        self._jobs.put((future, fn, args))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Kill the processes; tasks that wait are cancelled, those of this process end."""
        self.closed = True
        with contextlib.suppress(queue.Empty):
            while True:
                job = self._jobs.get_nowait()
                if job is not None:
                    job[0].cancel()
        for _ in self._threads:
            self._jobs.put(None)
        for process in tuple(self._processes):
            _kill(process)
        if wait:
            for thread in self._threads[: self._here]:
                thread.join()

    def _compute(self) -> None:
        for future, function, arguments in iter(self._jobs.get, None):
            if future.set_running_or_notify_cancel():
                _settle(future, partial(function, *arguments))

    def _hand_over(self) -> None:
        process = self._spawn()
        try:
            _ready(process)
        except RuntimeError:  # a script without its `if __name__ == "__main__":`; or dismissed
            if self._here or self.closed:
                return
        for future, function, arguments in iter(self._jobs.get, None):
            if not future.set_running_or_notify_cancel():
                continue
            _settle(future, partial(_elsewhere, process, function, *arguments))
            if isinstance(future.exception(), WorkerDiedError) and not self.closed:
                self._processes.discard(process)
                process.shutdown(wait=False)
                process = self._spawn()

    def _spawn(self) -> ProcessPoolExecutor:
        process = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _start)
        self._processes.add(process)
        return process


def _settle(future: Future[Any], call: Callable[[], Any]) -> None:
    try:
        result = call()
    except BrokenExecutor as error:
        future.set_exception(WorkerDiedError(str(error)))
    except BaseException as error:
        future.set_exception(error)
    else:
        future.set_result(result)


def _elsewhere(process: ProcessPoolExecutor, function: Callable[..., Any], *arguments: Any) -> Any:
    return process.submit(_alone, function, *arguments).result()


def _alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """A task on one thread of BLAS, as every core has a process already."""
    with one_thread():
        return function(*arguments)


def _ready(process: ProcessPoolExecutor) -> None:
    """Start a process and wait until it can compute."""
    _elsewhere(process, _imported)


def _imported() -> None:
    """Import what a batch needs."""
    from estbench.montecarlo import worker  # noqa: F401


def _kill(process: ProcessPoolExecutor) -> None:
    """Kill a process; its unfinished task gives no result."""
    children = list((getattr(process, "_processes", None) or {}).values())
    process.shutdown(wait=False, cancel_futures=True)
    for child in children:
        with contextlib.suppress(OSError, ValueError):
            child.kill()


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


_kept: list[Team] = []


def stands(here: int, spawned: int) -> bool:
    """Whether a team of this size is kept, all of whose code is as it was imported."""
    now = sources()
    return any(
        not team.closed and team.size == (here, spawned) and team.sources.items() <= now.items()
        for team in _kept
    )


def kept(here: int, spawned: int) -> Team:
    """The team of this process, made anew if another size is wanted or its code has changed."""
    if not stands(here, spawned):
        for team in tuple(_kept):
            dismiss(team)
        _kept.append(Team(here, spawned))
    _kept[0].sources = sources()
    return _kept[0]


def dismiss(team: Executor) -> None:
    """End a team; the next experiment has a new one."""
    if team in _kept:
        _kept.remove(team)  # type: ignore[arg-type]
    team.shutdown(wait=True)


def sources() -> dict[str, int]:
    """When each imported file of the user's was written; a process has imported it as it was."""
    found = {}
    for module in tuple(sys.modules.values()):
        name = getattr(module, "__file__", None)
        if name and not name.startswith((sys.prefix, sys.base_prefix)):
            with contextlib.suppress(OSError):
                found[name] = Path(name).stat().st_mtime_ns
    return found
