"""The readings of one channel, or of several alike, on many rows: sampled, altered, delivered.

A row is one robot. Time is counted in ticks, physics steps since the simulation began; each row has
its own clock, which starts at the tick at which its episode begins. Every random number comes from
the stream of the run that a row is in, so a run is the same in any company.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from estbench.randomness import streams
from estbench.randomness.row_draws import BLOCK, RowDraws
from estbench.randomness.streams import Seeds
from estbench.sensors import imperfections
from estbench.sensors.channel import Channel
from estbench.sensors.delivery import Delivery
from estbench.sensors.imperfections import Imperfections
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.spaces.linalg import surely_finite
from estbench.spaces.manifold import product
from estbench.spaces.selection import chosen, select

NEVER = int(np.iinfo(np.int64).max)


class Sampler:
    """A channel, or several that are sampled together, on some rows, reading after reading.

    Args:
        channels: one, or several that are `alike`.
        rows: how many.
        last: tick after which no reading is due; None for no end.

    Attributes:
        channels: those given.
        width: numbers in a reading of all of them.
    """

    def __init__(self, channels: Sequence[Channel], rows: int, last: int | None = None):
        channel = channels[0]
        self.channels, self.channel = tuple(channels), channel
        self._rows, self._last = rows, last
        self._space = channel.space if len(channels) == 1 else product([c.space for c in channels])
        self.width = self._space.nx
        self._names = tuple(c.name for c in channels)
        self._widths = tuple(c.space.nx for c in channels)
        timing, name, m, part = channel.timing, channel.name, channel.space.n, channel.imperfections
        block = BLOCK if last is None else len(timing.due(last))
        widths = {f"sensor:{c.name}": c.space.n for c in channels}
        self._noise = RowDraws(rows, widths, block=block, shape=_noise(channels))
        normals, uniforms = ({}, {}) if part is None else (part.normals(m), part.uniforms())
        self._draws = {
            k: RowDraws(
                rows, {f"sensor:{name}:{k}": w}, "normal" if k in normals else "uniform", block
            )
            for k, w in (normals | uniforms).items()
        }
        self._jitter = RowDraws(rows, {f"sensor:{name}:jitter": 1}, "uniform", block)
        self._latency = RowDraws(rows, {f"sensor:{name}:latency": 1}, block=block)
        self._memory: imperfections.State | None = None
        # Of each row: where its episode began, its next reading, when that is due and taken.
        self._begin, self._number = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
        self._due, self._next = np.zeros(rows, np.int64), np.full(rows, NEVER)
        self._shared: int | None = None  # the next, where it is the same in all rows,
        self._shared_number, self._shared_begin = 0, 0  # its number, and where they began
        self._exact = not channel.cov.any()  # ⊞ 0 would round a quaternion
        self._late = bool(timing.latency or timing.latency_std)
        self._waiting: list[tuple[int, Delivery]] = []
        self._soonest = NEVER

    def start(self, rows: Int[Ints, " k"], seed: Seeds, runs: Sequence[int], tick: int) -> None:
        """Begin episodes in some rows: the sensor is switched on, what was on its way is lost.

        Args:
            rows: their numbers.
            seed: of all of them, or one for each.
            runs: the number of the run in each.
            tick: now.
        """
        here = chosen(rows, self._rows)
        self._separate()
        self._noise.start(rows, seed, runs)
        for draws in self._draws.values():
            draws.start(rows, seed, runs)
        timing = self.channel.timing
        if timing.jitter:
            self._jitter.start(rows, seed, runs)
        if timing.latency_std:
            self._latency.start(rows, seed, runs)
        if self.channel.imperfections is not None:
            self._switch_on(self.channel.imperfections, rows, here, seed, runs)
        self._begin[rows], self._number[rows] = tick, 0
        self._plan(here)
        others = [
            (at, d._replace(mask=~here if d.mask is None else d.mask & ~here))
            for at, d in self._waiting
        ]
        self._waiting = [(at, d) for at, d in others if d.mask is not None and d.mask.any()]
        if here.all() and not timing.jitter:
            self._shared, self._shared_number, self._shared_begin = int(self._next[0]), 0, tick

    def takes(self, tick: int) -> bool:
        """Whether any row takes a reading at this tick."""
        if self._shared is not None:
            return self._shared <= tick
        return bool((self._next <= tick).any())

    def at(
        self,
        tick: int,
        clean: Float[Array, "row ny"] | None,
        moved: Bool[Mask, " row"] | None = None,
    ) -> list[Delivery]:
        """What arrives at a tick.

        Args:
            tick: now; it never goes back.
            clean: noise-free readings `(row, ny)`, where any row takes one.
            moved: rows for which time has passed `(row,)`; None is all.
        """
        if clean is not None:
            delivery, number = self._take(tick, clean, moved)
            if not self._late:
                return [delivery]
            self._send(delivery, number)
        return self._receive(tick, moved) if tick >= self._soonest else []

    def _receive(self, tick: int, moved: Mask | None) -> list[Delivery]:
        """What has arrived by now, in the order in which it was sent, in the rows that go on."""
        arrived: list[Delivery] = []
        waiting: list[tuple[int, Delivery]] = []
        for at, delivery in self._waiting:
            if at > tick:
                waiting.append((at, delivery))
                continue
            if moved is None:
                arrived.append(delivery)
                continue
            mask = moved if delivery.mask is None else delivery.mask & moved
            if mask.any():
                arrived.append(delivery._replace(mask=mask))
            rest = ~moved if delivery.mask is None else delivery.mask & ~moved
            if rest.any():
                waiting.append((at, delivery._replace(mask=rest)))
        self._waiting = waiting
        self._soonest = min((at for at, _ in waiting), default=NEVER)
        return arrived

    def _take(self, tick: int, clean: Array, moved: Mask | None) -> tuple[Delivery, int | Ints]:
        """The readings that are due, and the number of each row's."""
        if self._shared is not None and moved is None:
            due, here, number = self._shared, None, self._shared_number
            y, got = self._returned(clean, None, tick - self._shared_begin)
            self._shared = self._upcoming(tick)
        else:
            self._separate()
            taking = self._next <= tick if moved is None else (self._next <= tick) & moved
            here, due, number = None if taking.all() else taking, self._due, self._number.copy()
            y, got = self._returned(clean, here, tick - self._begin)
            while taking.any():  # a step of an environment may pass over more than one
                self._number[taking] += 1
                self._plan(taking)
                taking = taking & (self._next <= tick)
        mask = got if here is None else here if got is None else here & got
        return Delivery(self._names, due, y, mask, tick, self._widths), number

    def _send(self, delivery: Delivery, number: int | Ints) -> None:
        """Put readings on their way, those that arrive together as one delivery."""
        timing, normal = self.channel.timing, 0.0
        mask = np.ones(self._rows, bool) if delivery.mask is None else delivery.mask
        if timing.latency_std:
            normal = self._latency.draw(self._drawn)[:, 0]
        taken = delivery.taken - self._begin
        arrives = self._begin + timing.arrival_tick(taken, number, normal)
        for arrival in np.unique(arrives[mask]).tolist():
            together = mask & (arrives == arrival)
            packet = delivery._replace(mask=None if together.all() else together)
            self._waiting.append((arrival, packet))
            self._soonest = min(self._soonest, arrival)

    def _returned(
        self, clean: Array, here: Mask | None, taken: int | Ints
    ) -> tuple[Array, Mask | None]:
        """As `_read`, of true readings of which a component without a return is +inf.

        The sensor's noise and memory go on as if the true reading were zero there.
        """
        if surely_finite(clean):
            return self._read(clean, here, taken)
        gone = np.isinf(clean)
        y, got = self._read(np.where(gone, 0.0, clean), here, taken)
        seen = np.any(~gone, axis=1)
        return np.where(gone, np.inf, y), np.asarray(seen if got is None else got & seen)

    def _read(
        self, clean: Array, here: Mask | None, taken: int | Ints
    ) -> tuple[Array, Mask | None]:
        """A reading `(row, ny)` with all that the sensor does to it, and who gets it `(row,)`.

        Args:
            clean: noise-free readings `(row, ny)`.
            here: rows that take it; None is all.
            taken: ticks since the episode began at which it is taken, of all rows or `(row,)`.
        """
        channel, part = self.channel, self.channel.imperfections
        self._drawn = here
        noise = self._noise.draw(here)
        if channel.schedule is not None:
            noise = self._scheduled(noise, taken)
        if part is None or self._memory is None:
            return (clean if self._exact else self._space.plus(clean, noise)), None
        draws = {purpose: numbers.draw(here) for purpose, numbers in self._draws.items()}
        time = np.full((self._rows, 1), channel.timing.timestep)
        time *= taken if isinstance(taken, int) else taken[:, None]
        state = imperfections.advance(part, noise, self._memory, draws, time)
        if here is not None:
            state = select(here, state, self._memory, "sensor")
        y, self._memory = imperfections.respond(part, channel.space, clean, state, here)
        return y, ~self._memory.lost if part.dropout else None

    def _scheduled(self, white: Array, taken: int | Ints) -> Array:
        """Noise `(row, m)` of readings taken at these ticks, from standard normals `(row, m)`."""
        channel, timestep = self.channel, self.channel.timing.timestep
        if isinstance(taken, int):
            return channel.noise_from(white, timestep * taken)
        out = np.empty_like(white)
        for tick in np.unique(taken):
            out[taken == tick] = channel.noise_from(white[taken == tick], float(timestep * tick))
        return out

    def _switch_on(
        self, part: Imperfections, rows: Ints, here: Mask, seed: Seeds, runs: Sequence[int]
    ) -> None:
        """The memory of the sensor in some rows as it is at the start; constants are drawn."""
        draws, space = {}, self.channel.space
        for purpose, width in part.constants(space.n).items():
            draws[purpose] = np.zeros((self._rows, width))
            name = f"sensor:{self.channel.name}:{purpose}"
            draws[purpose][rows] = streams.normals(seed, runs, name, 1, width)[0]
        fresh = replace(
            imperfections.start(part, draws, self._rows, space.n),
            time=np.zeros((self._rows, 1)),  # of each row
            last=np.zeros((self._rows, space.nx)) if part.stuck else None,
        )
        old = self._memory
        self._memory = fresh if old is None else select(here, fresh, old, "sensor")

    def _separate(self) -> None:
        """From now on each row has its own next reading."""
        if self._shared is not None:
            self._due[:] = self._next[:] = self._shared
            self._number[:], self._shared = self._shared_number, None

    def _upcoming(self, tick: int) -> int:
        """The tick of the next reading of all rows, after this one."""
        while True:
            self._shared_number += 1
            due = int(self.channel.timing.due_tick(self._shared_number))
            if self._last is not None and due > self._last:
                return NEVER
            if self._shared_begin + due > tick:
                return self._shared_begin + due

    def _plan(self, here: Mask) -> None:
        """When some rows take their next reading."""
        timing = self.channel.timing
        due = timing.due_tick(self._number)
        at = due
        if timing.jitter:
            at = timing.sampling_tick(due, self._jitter.draw(here)[:, 0])
        at = self._begin + at
        if self._last is not None:
            at = np.where(due > self._last, NEVER, at)
        self._due = np.where(here, self._begin + due, self._due)
        self._next = np.where(here, at, self._next)


def alike(channels: Sequence[Channel]) -> list[list[Channel]]:
    """The channels, those together that can be sampled together: a step then costs less.

    These have white noise only, uncorrelated and constant, the same sampling times and no latency.
    """
    groups: dict[object, list[Channel]] = {}
    for channel in channels:
        timing, R = channel.timing, channel.cov
        white = channel.imperfections is None and channel.schedule is None
        plain = white and timing.punctual and R.any() and not (R - np.diag(np.diag(R))).any()
        key = (timing.period, timing.phase) if plain else channel.name
        groups.setdefault(key, []).append(channel)
    return list(groups.values())


def _noise(channels: Sequence[Channel]) -> Callable[[Array], Array] | None:
    """What makes noise `(..., m)` of standard normals; None where a schedule has to say it."""
    if len(channels) > 1:
        std = np.concatenate([np.diag(channel.factor) for channel in channels])
        return partial(np.multiply, std)
    return None if channels[0].schedule else partial(channels[0].noise_from, t=0.0)
