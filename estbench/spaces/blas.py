"""BLAS on one thread: matrices of a filter are small, and the cores have work already.

OpenBLAS shares a product or a QR of some dozen rows over all cores, and waits for the slowest: the
QR of 93 x 93 numbers takes 0.3 ms on one thread, and up to 25 ms on two busy cores.
"""

import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module

VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
"""Who sets one of these knows better."""
MODULES = ("numpy.linalg._umath_linalg", "scipy.linalg._flapack")
"""Each links its own BLAS."""
NAMES = tuple(f"{a}openblas_{{}}_num_threads{b}" for a in ("scipy_", "") for b in ("64_", ""))
_lock = threading.Lock()
_inside = 0
_before: list[int] = []


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenBLAS computes on the thread that calls it, in the whole process, until the last is left.

    Nothing changes where another BLAS is linked, or its threads are set in the environment.
    """
    global _inside
    with _lock:
        _inside += 1
        if _inside == 1:
            _before[:] = [get() for get, _ in _libraries()]
            for _, put in _libraries():
                put(1)
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                for count, (_, put) in zip(_before, _libraries()):
                    put(count)


@cache
def _libraries() -> tuple[tuple[Callable[[], int], Callable[[int], None]], ...]:
    """Reads and sets the count of threads of each OpenBLAS that is linked."""
    found = []
    for module in () if any(name in os.environ for name in VARIABLES) else MODULES:
        try:  # a symbol is found in what the module links, too
            linked = ctypes.CDLL(import_module(module).__file__)
        except (ImportError, OSError, TypeError):
            continue
        for name in NAMES:
            if hasattr(linked, name.format("set")):
                found.append((linked[name.format("get")], linked[name.format("set")]))
                break
    return tuple(found)
