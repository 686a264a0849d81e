"""When channels sample, when their readings arrive, and the instants of the event loop.

Times are counted in physics steps (ticks); every instant is one. A channel is due at
phase, phase + period, ... (the first after t = 0; without a phase at its first period, as P₀ says
what is known before). With jitter a run's reading is taken some ticks off. It arrives at once, or
with latency some ticks later, at the first instant that is not earlier.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import ScenarioError
from estbench.shapes import Array, Ints

MOST_INSTANTS = 5_000_000
"""Most instants of a run: each takes half a kilobyte, these 2.5 GB."""
_REMEMBERED = 10_000
"""Control periods that a schedule remembers."""


@dataclass(frozen=True)
class Native:
    """A sensor's rhythm as its MJCF says it, in s; a sensor without a history has none.

    Attributes:
        period: `interval`'s first number; 0 for every physics step.
        phase: its second, in (-period, 0]: readings are due at phase + period, ....
        delay: `delay`, read from the history without interpolation.
        nsample: readings that the history holds; MuJoCo ignores the rest unless it is positive.
    """

    period: float = 0.0
    phase: float = 0.0
    delay: float = 0.0
    nsample: int = 0

    def timing(self, timestep: float, default: int) -> "Timing":
        """The rhythm in physics steps; `default` steps between readings where it has no period."""
        delay = self.delay / timestep if self.nsample else 0.0
        if not self.nsample or self.period <= 0:
            # Without a period the history holds a reading a physics step.
            return Timing(default, latency=min(delay, float(self.nsample)), timestep=timestep)
        interval = max(1.0, self.period / timestep)
        first = max(1.0, (self.phase + self.period) / timestep)
        slots = self.nsample if delay > 0 else 0
        even = all(abs(value - round(value)) < 1e-6 for value in (first, interval))
        return Timing(
            round(interval) if even else int(interval), round(first) if even else 0,
            latency=delay, timestep=timestep, uneven=None if even else (first, interval),
            slots=slots,
        )  # fmt: skip


@dataclass(frozen=True)
class Instant:
    """The end of one interval of the event loop.

    Attributes:
        start, end: s.
        nstep: physics steps between them.
        channels: names of the channels that are due at `end`.
        control: whether the controller is asked at `start`.
        tick: physics steps since t = 0 at `end`.
    """

    start: float
    end: float
    nstep: int
    channels: tuple[str, ...]
    control: bool
    tick: int


@dataclass(frozen=True)
class Timing:
    """Rate, phase, jitter and latency of a channel, in ticks.

    Attributes:
        period: between readings.
        phase: of the first reading; 0 means one period.
        jitter: largest deviation of the sampling time; less than half a period.
        latency: mean time from sampling to arrival.
        latency_std: its standard deviation.
        timestep: s a tick.
        uneven: first reading and interval where they are no whole counts of ticks; a reading is
            then taken at the first tick that is not earlier.
        slots: readings that a MuJoCo history holds: one is pushed out, and so arrives, a tick after
            the last of them was taken; 0 for no limit.
    """

    period: int
    phase: int = 0
    jitter: int = 0
    latency: float = 0.0
    latency_std: float = 0.0
    timestep: float = 1.0
    uneven: tuple[float, float] | None = None
    slots: int = 0

    @property
    def punctual(self) -> bool:
        """Whether every reading is taken in an even rhythm and arrives at once."""
        return not (self.jitter or self.latency or self.latency_std or self.uneven)

    @property
    def longest(self) -> int:
        """Ticks after which a reading has all but surely arrived (five standard deviations)."""
        return int(np.ceil(self.latency + 5 * self.latency_std - 1e-9)) + self.jitter

    def due(self, ticks: int) -> Ints:
        """Ticks `(reading,)` at which readings are due up to `ticks`."""
        first, interval = self.uneven or (self.phase or self.period, self.period)
        due = self.due_tick(np.arange(max(0, int((ticks - first) / interval) + 1)))
        return due[due <= ticks]

    def due_tick(self, reading: Ints) -> Ints:
        """The tick at which the readings of these numbers, from 0, are due."""
        if self.uneven is None:
            return (self.phase or self.period) + self.period * reading
        first, interval = self.uneven
        return np.ceil(first + interval * reading - 1e-6).astype(np.int64)

    def due_between(self, after: int, until: int) -> list[int]:
        """The ticks in (after, until] at which readings are due."""
        first, interval = self.uneven or (self.phase or self.period, self.period)
        lowest = max(0, int((after - first) / interval))
        ticks = self.due_tick(np.arange(lowest, int((until - first) / interval) + 2))
        return ticks[(ticks > after) & (ticks <= until)].tolist()

    def sampling_tick(self, due: Ints, uniform: Array) -> Ints:
        """The tick at which a reading is taken that is due at `due`, from uniforms on [0, 1)."""
        off = np.floor(uniform * (2 * self.jitter + 1)).astype(np.int64) - self.jitter
        return np.maximum(due + off, 1)

    def arrival_tick(self, sampled: Ints, reading: Ints, normal: Array | float = 0.0) -> Ints:
        """The tick at which a reading arrives that was taken at `sampled`.

        A random latency is a normal number, but never negative.

        Args:
            sampled: `(row,)`.
            reading: its number, from 0 `(row,)`.
            normal: standard normals `(row,)`.
        """
        late = np.maximum(self.latency + self.latency_std * normal, 0.0)
        out = sampled + np.ceil(late - 1e-6).astype(np.int64)
        if self.slots:
            out = np.minimum(out, self.due_tick(reading + self.slots - 1) + 1)
        return out


class Schedule:
    """The instants of the event loop, one control period after the other.

    Args:
        channels: name and timing of each channel.
        timestep: physics step, s.
        frame_skip: physics steps of a control period, which is the filter's step.
        last: tick after which no reading is due; None for no end.

    Attributes:
        timestep: physics step, s.
        frame_skip: physics steps of a control period.
        plain: whether every control period is one interval: no channel samples in between.

    Raises:
        ScenarioError: a jitter would change the readings' order.
    """

    def __init__(
        self,
        channels: Sequence[tuple[str, Timing]],
        timestep: float,
        frame_skip: int,
        last: int | None = None,
    ):
        for name, timing in channels:
            if timing.jitter and 2 * timing.jitter >= timing.period:
                raise ScenarioError(
                    f"channels.{name}.jitter is {timing.jitter * timestep:g} s; it must be less "
                    f"than half the period {timing.period * timestep:g} s, or readings would "
                    "change order"
                )
        self._channels, self._last = tuple(channels), last
        self.timestep, self.frame_skip = timestep, frame_skip
        self.plain = not any(between(timing, frame_skip) for _, timing in channels)
        self._known: dict[int, tuple[Instant, ...]] = {}

    def period(self, k: int) -> tuple[Instant, ...]:
        """The instants of the k-th control period, from 0."""
        if k not in self._known:
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[k] = tuple(self._period(k))
        return self._known[k]

    def _period(self, k: int) -> Iterator[Instant]:
        before, end = k * self.frame_skip, (k + 1) * self.frame_skip
        ticks, due = {end}, dict[int, list[str]]()
        for name, timing in self._channels:
            j = timing.jitter
            latest = end + j if self._last is None else min(end + j, self._last)
            for tick in timing.due_between(before - j - 1, latest):
                if before < tick <= end:
                    due.setdefault(tick, []).append(name)
                ticks.update(t for t in range(tick - j, tick + j + 1) if before < t <= end)
        for tick in sorted(ticks):
            names, control = tuple(due.get(tick, ())), before % self.frame_skip == 0
            yield Instant(
                before * self.timestep, tick * self.timestep, tick - before, names, control, tick
            )
            before = tick


def between(timing: Timing, frame_skip: int) -> bool:
    """Whether a channel samples between the ends of control periods."""
    return bool(
        timing.jitter or timing.uneven or timing.period % frame_skip or timing.phase % frame_skip
    )


def instants(
    channels: Sequence[tuple[str, Timing]], timestep: float, frame_skip: int, duration: float
) -> list[Instant]:
    """The instants of the event loop: every filter step and every sampling time, in order.

    The last filter step ends at the duration rounded to a whole count of them (at least one).

    Args:
        channels: name and timing of each channel.
        timestep: physics step, s.
        frame_skip: physics steps of a filter step.
        duration: s.

    Raises:
        ScenarioError: more than `MOST_INSTANTS`, or a jitter that would change the readings' order.
    """
    _check_count(channels, timestep, frame_skip, duration)
    count = max(1, round(duration / (timestep * frame_skip)))
    schedule = Schedule(channels, timestep, frame_skip, count * frame_skip)
    return [instant for k in range(count) for instant in schedule.period(k)]


def _check_count(
    channels: Sequence[tuple[str, Timing]], timestep: float, frame_skip: int, duration: float
) -> None:
    """Refuse a run whose instants would not fit into memory, before any of them is made."""
    # What falls on the filter's steps adds no instant, nor does a rhythm that another channel has.
    added = {timing for _, timing in channels if between(timing, frame_skip)}
    rates = [(2 * t.jitter + 1) / (t.uneven[1] if t.uneven else t.period) for t in added]
    ticks = duration / timestep
    steps, count = ticks / frame_skip, ticks * min(1.0, 1 / frame_skip + sum(rates))
    if count > MOST_INSTANTS:
        raise ScenarioError(
            f"duration is {duration:g} s: {steps:.3g} steps of {frame_skip * timestep:g} s, with "
            f"the readings between them {count:.3g} instants, and a run has at most "
            f"{MOST_INSTANTS:,}; it is in seconds: shorten it, or raise model.frame_skip"
        )
