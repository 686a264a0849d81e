"""BLAS on one thread: matrices of a filter are small, and the cores have work already.

OpenBLAS shares a product or a QR of some dozen rows over all cores, and waits for the slowest: the
QR of 93 x 93 numbers takes 0.3 ms on one thread, and up to 25 ms on two busy cores.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController

VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
"""Who sets one of these knows better."""
_lock = threading.Lock()
_inside = 0
_limited = ExitStack()


@contextmanager
def one_thread() -> Iterator[None]:
    """BLAS computes on the thread that calls it, in the whole process, until the last is left.

    Nothing changes where its threads are set in the environment.
    """
    global _inside
    with _lock:
        _inside += 1
        if _inside == 1 and not any(name in os.environ for name in VARIABLES):
            _limited.enter_context(_libraries().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                _limited.close()


@cache
def _libraries() -> ThreadpoolController:
    """The libraries that are loaded: numpy and scipy have a BLAS each."""
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
