"""The bound along a trajectory that passes by, window after window."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estbench.bounds import recursion
from estbench.bounds.expectation import whitened
from estbench.bounds.recursion import Key, Step, Variations
from estbench.bounds.scenario import RUNS, beginning, true_system
from estbench.experiment.prepared import Setup
from estbench.sensors.delivery import Delivery
from estbench.shapes import Array, Bool, Float, Mask
from estbench.simulation.sources import Trajectory
from estbench.spaces.linalg import quiet


class PassingBound:
    """`scenario.bound_of_runs`, of runs whose readings arrive when they are taken.

    Each run has its own combinations from the first window on in which readings are missing in
    some runs (see `bounds.recursion`).

    Args:
        setup: the experiment.
        runs: their numbers.
        x0: true states at the start.
    """

    def __init__(self, setup: Setup, runs: Sequence[int], x0: Float[Array, "run nx"]):
        self._setup, self._rows = setup, len(runs)
        self._few = [place for place, run in enumerate(runs) if run < RUNS]
        self._next = 0  # the index of the first time of the next window
        self._now: Variations | None = None
        if self._few:
            self._system, factor = true_system(setup, [runs[place] for place in self._few])
            self._now = recursion.start(factor, beginning(setup, factor, x0[self._few]))

    def forward(self, happened: Trajectory) -> Float[Array, "time run n"]:
        """The values of a window; the first is that of the last time of the one before."""
        n, few, now = self._setup.space.n, self._few, self._now
        out = np.full((len(happened.x), self._rows, n), np.nan)
        if now is None:
            return out
        masked = any(d.mask is not None for arrived in happened.deliveries for d in arrived)
        if masked and now.expected is None:
            now = replace(now, factor=now.factor[None].repeat(len(now.xi), 0), expected={})
        out[0, few] = now.values()[:, :n]
        with quiet():
            for i, arrived in enumerate(happened.deliveries, 1):
                now = self._step(now, happened, i, arrived)
                out[i, few] = now.values()[:, :n]
        self._now, self._next = now, self._next + len(happened.deliveries)
        return out

    def _step(
        self, now: Variations, happened: Trajectory, i: int, arrived: Sequence[Delivery]
    ) -> Variations:
        """The variations at the i-th time of a window."""
        few, instant = self._few, self._setup.instants[self._next + i - 1]
        x, u, k = happened.x[i, few], happened.u[i - 1, few], self._next + i
        before, start, end = happened.x[i - 1, few], instant.start, instant.end
        F, G = self._system.transition(before, x, u, start, end - start)
        seen = whitened(self._system, k, [d.channels for d in arrived], x, u, end)
        came: list[tuple[Key, Bool[Mask, " run"] | None]] = [
            ((k, d.channels), None if d.mask is None else d.mask[few]) for d in arrived
        ]
        return recursion.step(now, Step(F, G, seen, came))
