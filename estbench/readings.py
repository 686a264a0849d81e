"""The readings of some runs' sensors: who samples when, what is delivered, when it arrives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estbench import imperfections, streams
from estbench.schedules import factor
from estbench.sensors import Channel
from estbench.timing import Instant

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Delivery:
    """Readings of one channel, due at one instant, that arrive at one instant.

    Attributes:
        channel: its name.
        due: index of the instant that the readings are labelled with.
        y: `(run, ny)`; only the rows of `mask` mean anything.
        mask: runs whose reading arrives now `(run,)`; None means all.
    """

    channel: str
    due: int
    y: Array
    mask: Mask | None


class Readings:
    """One channel on some runs, reading after reading.

    Every random number is drawn beforehand from the runs' own streams.

    Args:
        channel: the sensor.
        instants: of the event loop.
        seed, runs: whose streams.
    """

    def __init__(
        self, channel: Channel, instants: Sequence[Instant], seed: int, runs: Sequence[int]
    ):
        self.channel = channel
        self._runs = len(runs)
        ticks = np.array([i.tick for i in instants])
        last = int(ticks[-1])
        timing, name, m = channel.timing, channel.name, channel.space.n
        due = timing.due(last)
        self._due = np.searchsorted(ticks, due)
        self._times = due * timing.timestep
        self._noise = channel.noise(seed, runs, len(due))
        part = channel.part
        self._draws: dict[str, Array] = {}
        if part is not None:
            purpose = f"sensor:{name}:"
            normals = {k: streams.normals(seed, runs, purpose + k, len(due), w)
                       for k, w in part.normals(m).items()}  # fmt: skip
            uniforms = {k: streams.uniforms(seed, runs, purpose + k, len(due), w)
                        for k, w in part.uniforms().items()}  # fmt: skip
            constants = {k: streams.normals(seed, runs, purpose + k, 1, w)[0]
                         for k, w in part.constants(m).items()}  # fmt: skip
            self._draws = normals | uniforms
            self._state = imperfections.start(part, constants, len(runs), m)
        self._punctual = timing.punctual
        # Instant -> readings that are taken then.
        self._take = {int(k): [j] for j, k in enumerate(self._due)}
        if self._punctual:
            return
        sampled = timing.sampled(seed, runs, name, last)
        self._sampled = np.searchsorted(ticks, sampled)
        self._arrives = np.searchsorted(ticks, timing.arrived(seed, runs, name, last))
        self._complete = np.searchsorted(ticks, due + timing.jitter)
        self._take = {}
        for j, row in enumerate(self._sampled):
            for k in np.unique([*row, self._complete[j]]):
                self._take.setdefault(int(k), []).append(j)
        self._parts: dict[int, Array] = {}
        self._waiting: dict[int, list[Delivery]] = {}

    def takes(self, k: int) -> bool:
        """Whether any run takes a reading at instant k."""
        return k in self._take

    def at(self, k: int, clean: Array | None) -> list[Delivery]:
        """What arrives at instant k, given the noise-free readings `(run, ny)` if it takes any."""
        for j in self._take.get(k, ()) if clean is not None else ():
            if self._punctual:
                y, mask = self._deliver(j, clean)
                return [Delivery(self.channel.name, int(self._due[j]), y, mask)]
            self._collect(j, k, clean)
        return [] if self._punctual else self._waiting.pop(k, [])

    def _collect(self, j: int, k: int, clean: Array) -> None:
        """Take reading j in the runs that sample it now; send it off when all of them have."""
        parts = self._parts.setdefault(j, clean.copy())
        now = self._sampled[j] == k
        parts[now] = clean[now]
        if k != self._complete[j]:
            return
        y, mask = self._deliver(j, self._parts.pop(j))
        for arrival in np.unique(self._arrives[j]):
            there = self._arrives[j] == arrival
            there = there if mask is None else there & mask
            if there.any():
                packet = Delivery(
                    self.channel.name, int(self._due[j]), y, None if there.all() else there
                )
                self._waiting.setdefault(int(arrival), []).append(packet)

    def _deliver(self, j: int, clean: Array) -> tuple[Array, Mask | None]:
        """Reading j with everything that the sensor does to it."""
        channel, time = self.channel, float(self._times[j])
        noise = self._noise[j]
        if channel.schedule is not None:
            noise = noise * factor(channel.schedule, time)
        if channel.part is None:
            return channel.space.plus(clean, noise), None
        draws = {purpose: values[j] for purpose, values in self._draws.items()}
        y, mask, self._state = imperfections.deliver(
            channel.part, channel.space, clean, noise, self._state, draws, time
        )
        return y, mask
