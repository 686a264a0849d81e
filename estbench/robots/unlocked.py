"""CPU time that a thread computes inside of `Batch`, where it holds no lock of the interpreter.

It is counted only where somebody asks: to read a thread's CPU time takes 0.6 µs.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Count:
    """Seconds so far."""

    seconds: float = 0.0


class _Asked(threading.local):
    count: Count | None = None


_asked = _Asked()


@contextmanager
def counted() -> Iterator[Count]:
    """Count what this thread computes without the lock from here on."""
    _asked.count = count = Count()
    try:
        yield count
    finally:
        _asked.count = None


def begin() -> float:
    """A computation without the lock begins; what `end` is given."""
    return 0.0 if _asked.count is None else time.thread_time()


def end(began: float) -> None:
    """It ends."""
    if _asked.count is not None:
        _asked.count.seconds += time.thread_time() - began
