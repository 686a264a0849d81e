"""The workers of a dask.distributed cluster as a `concurrent.futures` executor."""

import asyncio
import logging
import time
from concurrent.futures import Executor

from estbench.errors import ExecutorError, MissingExtraError
from estbench.montecarlo.pool import Pool

TIMEOUT = 10.0
"""Seconds within which a scheduler must answer and know a worker."""


def pool(address: str | None) -> Pool:
    """The workers of the cluster at an address.

    Raises:
        ExecutorError: there is no address, or no scheduler with workers answers in time.
        MissingExtraError: dask.distributed is not installed.
    """
    if not address:
        raise ExecutorError(
            "executor dask needs the scheduler's address, e.g. tcp://127.0.0.1:8786"
        )
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("dask.distributed", "dask") from None
    # What is lost is said here, in one line. dask gives some of its loggers levels of their own.
    for name in ("distributed", "tornado", "asyncio", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
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
    since: list[float] = []

    def lost() -> bool:
        """Whether the client is closed, or no worker was there for `TIMEOUT`."""
        if client.status in ("closing", "closed"):
            return True
        try:
            there = client.status == "running" and client.nthreads()
        except (OSError, TimeoutError, RuntimeError):
            there = {}
        since[:] = [] if there else since[:1] or [time.monotonic()]
        return bool(since) and time.monotonic() - since[0] > TIMEOUT

    def close(executor: Executor) -> None:
        if not lost():
            executor.shutdown(wait=False)
        client.close()

    return Pool(
        lambda: client.get_executor(retries=2),
        workers,
        close,
        2 * workers,
        lost=lost,
    )


async def _knock(address: str) -> None:
    """Ask the scheduler for its identity; a `Client` has no time limit for one that never answers.

    Raises:
        OSError, TimeoutError, ValueError: it does not answer in `TIMEOUT`.
    """
    from distributed.core import rpc

    async with rpc(address, timeout=TIMEOUT) as scheduler:
        await asyncio.wait_for(scheduler.identity(), TIMEOUT)
