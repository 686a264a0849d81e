"""Over how many threads the rows of a call are shared: found by timing the calls themselves.

With T seconds of physics a call takes T / k + h on k threads. The hand-over h is some 8 µs between
idle cores and a millisecond where other programs have them; T depends on the robot and on what it
touches. So the calls that are made anyway are timed with each k. Results do not depend on k.
"""

import ctypes
import math
import multiprocessing
import os
from collections.abc import Generator
from statistics import median
from typing import Protocol
from weakref import WeakSet

CALLS = 9
"""Calls that are timed with each number of threads; the first, of a new batch, does not count."""
PAYS = 0.8
"""Twice the threads must bring the time of a call below this part of what it was."""
LEAST = 50e-6
"""Physics that each thread must have in a call, s: six hand-overs."""
REST = 100
"""A trial takes one part in so many of the time."""


Kind = tuple[int, str]
"""Calls that take alike: their rows, and what they are for."""


def free_cores() -> int:
    """CPUs that this process may use; 1 in a worker of `multiprocessing`, whose siblings use them.

    So it is in the workers of `AsyncVectorEnv` and `SubprocVecEnv`.
    """
    if multiprocessing.parent_process() is not None:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Threads:
    """The number of threads of each kind of call of one robot.

    Args:
        cores: that may be used.
    """

    def __init__(self, cores: int):
        self._cores = cores
        self._choices: dict[Kind, Generator[int, tuple[float, float], None]] = {}
        self._threads: dict[Kind, int] = {}

    def of(self, kind: Kind) -> int:
        """Threads of the next call."""
        if kind not in self._threads:
            self._choices[kind] = choices(min(kind[0], self._cores))
            self._threads[kind] = next(self._choices[kind])
        return self._threads[kind]

    def took(self, kind: Kind, began: float, ended: float) -> None:
        """The times between which a call was made with these threads, s."""
        self._threads[kind] = self._choices[kind].send((began, ended))


def choices(most: int) -> Generator[int, tuple[float, float], None]:
    """Threads of each next call, at most so many; is sent when the call began and ended.

    1, 2, 4, ... threads are tried as long as that pays; after a rest this begins anew, because
    robot and machine may have changed.
    """
    while True:
        trial, best, least = 1, 1, math.inf
        calls: list[tuple[float, float]] = []
        while True:
            for _ in range(CALLS):
                calls.append((yield trial))
            took = median(ended - began for began, ended in calls[1 - CALLS :])
            if took >= PAYS * least:
                break
            best, least, trial = trial, took, min(2 * trial, most)
            if trial == best or least * best < LEAST * trial:
                break
        start, now = calls[0][0], calls[-1][1]
        until = now + REST * (now - start)
        while now < until:
            _, now = yield best


class Threaded(Protocol):
    """Something with threads of its own."""

    def forked(self) -> None:
        """This process was forked from the one that has the threads."""
        ...


_threaded: "WeakSet[Threaded]" = WeakSet()


def tell_of_forks(one: Threaded) -> None:
    """Have `one.forked` called in processes that are forked from now on."""
    _threaded.add(one)


def _forked() -> None:
    for one in _threaded:
        one.forked()


def never_release(value: object) -> None:
    """Keep an object for the life of the process: its end would wait for threads that are not."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(value))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
