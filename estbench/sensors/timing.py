"""When channels sample, when their readings arrive, and the instants of the event loop.

Times are counted in physics steps (ticks); every instant is one. A channel is due at
phase, phase + period, ... (the first after t = 0; without a phase at its first period, as P₀ says
what is known before). With jitter a run's reading is taken some ticks off. It arrives at once, or
with latency some ticks later, at the first instant that is not earlier.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import ScenarioError
from estbench.randomness import streams
from estbench.shapes import Ints

MOST_INSTANTS = 5_000_000
"""Most instants of a run: each takes half a kilobyte, these 2.5 GB."""


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
        if self.uneven is None:
            return np.arange(self.phase or self.period, ticks + 1, self.period)
        first, interval = self.uneven
        count = max(0, int((ticks - first) / interval) + 1)
        due = np.ceil(first + interval * np.arange(count) - 1e-6).astype(np.int64)
        return due[due <= ticks]

    def sampled(self, seed: int, runs: Sequence[int], name: str, ticks: int) -> Ints:
        """Ticks `(reading, run)` at which each run's readings are taken."""
        due = self.due(ticks)[:, None] + np.zeros(len(runs), np.int64)
        if not self.jitter:
            return due
        z = streams.uniforms(seed, runs, f"sensor:{name}:jitter", len(due), 1)[..., 0]
        off = np.floor(z * (2 * self.jitter + 1)).astype(np.int64) - self.jitter
        return np.clip(due + off, 1, None)

    def arrived(self, sampled: Ints, seed: int, runs: Sequence[int], name: str, ticks: int) -> Ints:
        """Ticks `(reading, run)` at which readings arrive that were sampled so.

        A random latency is a normal number, but never negative.
        """
        late = np.full(sampled.shape, self.latency)
        if self.latency_std:
            z = streams.normals(seed, runs, f"sensor:{name}:latency", len(sampled), 1)[..., 0]
            late = np.maximum(late + self.latency_std * z, 0.0)
        out = sampled + np.ceil(late - 1e-6).astype(np.int64)
        if self.slots:
            following = self.due(ticks + self.slots * (self.period + 1))[self.slots - 1 :] + 1
            out = np.minimum(out, following[: len(out), None])
        return out


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
    last_tick = max(1, round(duration / (timestep * frame_skip))) * frame_skip
    ticks = set(range(frame_skip, last_tick + 1, frame_skip))
    due: dict[int, list[str]] = {}
    for name, timing in channels:
        if timing.jitter and 2 * timing.jitter >= timing.period:
            raise ScenarioError(
                f"channels.{name}.jitter is {timing.jitter * timestep:g} s; it must be less than "
                f"half the period {timing.period * timestep:g} s, or readings would change order"
            )
        for tick in timing.due(last_tick).tolist():
            due.setdefault(tick, []).append(name)
            around = range(tick - timing.jitter, tick + timing.jitter + 1)
            ticks.update(t for t in around if 0 < t <= last_tick)
    out: list[Instant] = []
    before = 0
    for tick in sorted(ticks):
        names = tuple(due.get(tick, ()))
        control = before % frame_skip == 0
        out.append(Instant(before * timestep, tick * timestep, tick - before, names, control, tick))
        before = tick
    return out


def _check_count(
    channels: Sequence[tuple[str, Timing]], timestep: float, frame_skip: int, duration: float
) -> None:
    """Refuse a run whose instants would not fit into memory, before any of them is made."""
    # What falls on the filter's steps adds no instant, nor does a rhythm that another channel has.
    between = {
        timing
        for _, timing in channels
        if timing.jitter or timing.uneven or timing.period % frame_skip or timing.phase % frame_skip
    }
    rates = [(2 * t.jitter + 1) / (t.uneven[1] if t.uneven else t.period) for t in between]
    ticks = duration / timestep
    steps, count = ticks / frame_skip, ticks * min(1.0, 1 / frame_skip + sum(rates))
    if count > MOST_INSTANTS:
        raise ScenarioError(
            f"duration is {duration:g} s: {steps:.3g} steps of {frame_skip * timestep:g} s, with "
            f"the readings between them {count:.3g} instants, and a run has at most "
            f"{MOST_INSTANTS:,}; it is in seconds: shorten it, or raise model.frame_skip"
        )
