"""The readings of some runs' sensors: who samples when, what is delivered, when it arrives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.randomness import streams
from estbench.sensors.channel import Channel
from estbench.sensors.imperfections import advance, respond, start
from estbench.sensors.timing import Instant
from estbench.shapes import Array, Mask


@dataclass(frozen=True, eq=False)
class Delivery:
    """Readings of one channel, taken at one instant, that arrive at one instant.

    Attributes:
        channel: its name.
        due: index of the instant at which they were due.
        y: `(run, ny)`; only the rows of `mask` mean anything.
        mask: runs whose reading arrives now `(run,)`; None means all.
        taken: index of the instant at which they were taken; without jitter `due`.
    """

    channel: str
    due: int
    y: Array
    mask: Mask | None
    taken: int


class Readings:
    """One channel on some runs, reading after reading.

    Every random number is drawn beforehand from the runs' own streams.

    Args:
        channel: the sensor.
        instants: of the event loop.
        seed: of the scenario.
        runs: whose streams.
    """

    def __init__(
        self, channel: Channel, instants: Sequence[Instant], seed: int, runs: Sequence[int]
    ):
        self.channel = channel
        ticks = np.array([i.tick for i in instants])
        last = int(ticks[-1])
        timing, name, m = channel.timing, channel.name, channel.space.n
        due = timing.due(last)
        self._due = np.searchsorted(ticks, due)
        self._times = timing.timestep * due.astype(np.float64)
        self._noise = channel.noise(seed, runs, self._times)
        imperfections = channel.imperfections
        if imperfections is not None:
            purpose = f"sensor:{name}:"
            normals = {k: streams.normals(seed, runs, purpose + k, len(due), w)
                       for k, w in imperfections.normals(m).items()}  # fmt: skip
            uniforms = {k: streams.uniforms(seed, runs, purpose + k, len(due), w)
                        for k, w in imperfections.uniforms().items()}  # fmt: skip
            constants = {k: streams.normals(seed, runs, purpose + k, 1, w)[0]
                         for k, w in imperfections.constants(m).items()}  # fmt: skip
            self._draws = normals | uniforms
            self._state = start(imperfections, constants, len(runs), m)
        self._advanced = -1
        self._punctual = timing.punctual
        if self._punctual:
            self._reading = {int(k): j for j, k in enumerate(self._due)}
            return
        sampled = timing.sampled(seed, runs, name, last)
        self._taken = np.searchsorted(ticks, sampled)
        self._arrives = np.searchsorted(ticks, timing.arrived(sampled, seed, runs, name, last))
        # No two readings share an instant: jitter is less than half a period.
        self._reading = {int(k): j for j, row in enumerate(self._taken) for k in np.unique(row)}
        self._waiting: dict[int, list[Delivery]] = {}

    def takes(self, k: int) -> bool:
        """Whether any run takes a reading at instant k."""
        return k in self._reading

    def at(self, k: int, clean: Array | None) -> list[Delivery]:
        """What arrives at instant k, given the noise-free readings `(run, ny)` if it takes any."""
        if clean is not None:
            j = self._reading[k]
            name, due = self.channel.name, int(self._due[j])
            if self._punctual:
                y, mask = self._read(j, clean, None)
                return [Delivery(name, due, y, mask, due)]
            here = self._taken[j] == k
            y, mask = self._read(j, clean, here)
            there = here if mask is None else here & mask
            for arrival in np.unique(self._arrives[j][there]):
                now = there & (self._arrives[j] == arrival)
                packet = Delivery(name, due, y, None if now.all() else now, k)
                self._waiting.setdefault(int(arrival), []).append(packet)
        return [] if self._punctual else self._waiting.pop(k, [])

    def _read(self, j: int, clean: Array, rows: Mask | None) -> tuple[Array, Mask | None]:
        """Reading j `(run, ny)` with all that the sensor does to it, and who gets it `(run,)`.

        Args:
            j: which reading.
            clean: noise-free readings `(run, ny)`.
            rows: runs that take it now `(run,)`; None is all.
        """
        channel, imperfections = self.channel, self.channel.imperfections
        if imperfections is None:
            exact = not channel.cov.any()  # ⊞ 0 would round a quaternion
            return (clean if exact else channel.space.plus(clean, self._noise[j])), None
        if j != self._advanced:
            draws = {purpose: values[j] for purpose, values in self._draws.items()}
            self._state = advance(
                imperfections, self._noise[j], self._state, draws, float(self._times[j])
            )
            self._advanced = j
        y, self._state = respond(imperfections, channel.space, clean, self._state, rows)
        return y, ~self._state.lost if imperfections.dropout else None
