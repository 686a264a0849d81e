"""The floor of a batch: the time inside the `mujoco.batch` calls that it makes.

Measured in the very run whose wall time is compared with it, so that both see the same states (a
step with contacts costs several times one without) and the same disturbances by other programs.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest import mock

from mujoco.batch import Batch


class Floor:
    """Seconds spent in Batch calls, and rows that went through them by (kind, argument)."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.seconds, self._clock = 0.0, clock
        self.rows: dict[tuple[object, ...], int] = {}

    def timed(self, kind: str):
        """Batch's own method with a clock around it."""
        original = getattr(Batch, kind)

        def call(batch: Batch, **arguments: int) -> None:
            key = (kind, *arguments.values())
            self.rows[key] = self.rows.get(key, 0) + batch.nsim
            began = self._clock()
            try:
                original(batch, **arguments)
            finally:
                self.seconds += self._clock() - began

        return call


@contextmanager
def floor(clock: Callable[[], float] = time.perf_counter) -> Iterator[Floor]:
    """Counts while the block runs; one thread only. The clock may be that of the CPU."""
    found = Floor(clock)
    with (
        mock.patch.object(Batch, "step", found.timed("step")),
        mock.patch.object(Batch, "forward", found.timed("forward")),
    ):
        yield found
