"""The floor of a batch: the time of the bare `mujoco.batch` calls it cannot avoid.

`recorded` notes every Batch call that estbench makes; `replay` makes the same calls, on the same
batches with the states they last had, and nothing else.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

from mujoco.batch import Batch

from estbench.models import rows

Call = tuple[Batch, int, int]


@contextmanager
def recorded() -> Iterator[list[Call]]:
    """The list of (batch, steps, stage) that fills while the block runs."""
    calls: list[Call] = []
    original = rows.Rows._run

    def run(self, batch, bad, nstep, stage):
        calls.append((batch, nstep, stage))
        return original(self, batch, bad, nstep, stage)

    with mock.patch.object(rows.Rows, "_run", run):
        yield calls


def replay(calls: list[Call]) -> float:
    """Seconds that the bare calls take."""
    states = {id(batch): batch.state.copy() for batch, _, _ in calls}
    began = time.perf_counter()
    spent = 0.0
    for batch, nstep, stage in calls:
        if nstep:
            # Back to a recorded state, outside the clock: stepping on would leave the trajectory.
            spent += time.perf_counter() - began
            batch.state[...] = states[id(batch)]
            began = time.perf_counter()
            batch.step(nstep=nstep)
        else:
            batch.forward(stage=stage)
    return spent + time.perf_counter() - began
