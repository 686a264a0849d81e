"""Sampling times of channels, arrival times of readings, and the instants of the event loop.

Times are counted in physics steps (ticks). The readings of a channel are due at phase,
phase + period, ...; without a phase the first one is due after one period, because P₀ describes
the knowledge at t = 0. Jitter shifts the sampling time of each reading, in each run, by a random
count of ticks. A reading with latency arrives at the first instant at or after its sampling time
plus the latency; without latency it arrives when it is sampled.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.errors import ScenarioError
from estbench.sensors.instants import Instant, Instants
from estbench.shapes import Array, Float, Int, Ints

MOST_INSTANTS = 5_000_000
"""Upper limit of the instants per run: 2.5 GB at half a kilobyte each, where all are held."""
_REMEMBERED = 10_000
"""Control periods that a schedule remembers."""


@dataclass(frozen=True)
class MjcfTiming:
    """The sampling times and the delay that the MJCF gives a sensor, in s.

    Attributes:
        period: first number of `interval`; 0 for every physics step.
        phase: second number of `interval`, in (-period, 0]: readings are due at phase + period,
            phase + 2 period, ....
        delay: `delay`; the history is read without interpolation.
        nsample: readings that the history holds; MuJoCo ignores the other attributes if it is 0.
    """

    period: float = 0.0
    phase: float = 0.0
    delay: float = 0.0
    nsample: int = 0

    def timing(self, timestep: float, default: int) -> "Timing":
        """The timing in physics steps; the period is `default` steps where the MJCF gives none."""
        delay = self.delay / timestep if self.nsample else 0.0
        if not self.nsample or self.period <= 0:
            # Without a period the history holds one reading per physics step.
            return Timing(default, latency=min(delay, float(self.nsample)), timestep=timestep)
        interval = max(1.0, self.period / timestep)
        first = max(1.0, (self.phase + self.period) / timestep)
        history = self.nsample if delay > 0 else 0
        even = all(abs(value - round(value)) < 1e-6 for value in (first, interval))
        return Timing(
            round(interval) if even else int(interval), round(first) if even else 0,
            latency=delay, timestep=timestep, fractional=None if even else (first, interval),
            history=history,
        )  # fmt: skip


@dataclass(frozen=True)
class Timing:
    """Rate, phase, jitter and latency of a channel, in ticks.

    Attributes:
        period: between readings; rounded down where `fractional` is given.
        phase: time of the first reading; 0 means one period.
        jitter: largest deviation of the sampling time; less than half a period.
        latency: mean time from sampling to arrival.
        latency_std: standard deviation of the latency.
        timestep: length of one tick, s.
        fractional: time of the first reading and interval between readings, where they are not
            integers; a reading is then sampled at the first tick that is not earlier.
        history: readings that MuJoCo's history holds, 0 for no limit. The oldest reading leaves
            a full history, and so arrives, one tick after the newest was sampled.
    """

    period: int
    phase: int = 0
    jitter: int = 0
    latency: float = 0.0
    latency_std: float = 0.0
    timestep: float = 1.0
    fractional: tuple[float, float] | None = None
    history: int = 0

    @property
    def interval(self) -> float:
        """Mean time between readings, s."""
        return (self.fractional[1] if self.fractional else self.period) * self.timestep

    @property
    def rate(self) -> float:
        """Mean rate of the readings, Hz."""
        return 1.0 / self.interval

    @property
    def first(self) -> float:
        """Due time of the first reading, s."""
        first = self.fractional[0] if self.fractional else self.phase or self.period
        return first * self.timestep

    @property
    def punctual(self) -> bool:
        """Whether all readings are sampled periodically and arrive when they are sampled."""
        return not (self.jitter or self.latency or self.latency_std or self.fractional)

    @property
    def longest_delay(self) -> int:
        """Upper limit of the arrival time after the due time, ticks (five standard deviations)."""
        return int(np.ceil(self.latency + 5 * self.latency_std - 1e-9)) + self.jitter

    def due(self, ticks: int) -> Int[Ints, " reading"]:
        """Ticks at which readings are due up to `ticks`."""
        first, interval = self.fractional or (self.phase or self.period, self.period)
        due = self.due_tick(np.arange(max(0, int((ticks - first) / interval) + 1)))
        return due[due <= ticks]

    def due_tick(self, reading: int | Ints) -> Any:
        """The tick at which the readings of these numbers, from 0, are due."""
        if self.fractional is None:
            return (self.phase or self.period) + self.period * reading
        first, interval = self.fractional
        return np.ceil(first + interval * reading - 1e-6).astype(np.int64)

    def due_between(self, after: int, until: int) -> list[int]:
        """The ticks in (after, until] at which readings are due."""
        first, interval = self.fractional or (self.phase or self.period, self.period)
        lowest = max(0, int((after - first) / interval))
        ticks = self.due_tick(np.arange(lowest, int((until - first) / interval) + 2))
        return ticks[(ticks > after) & (ticks <= until)].tolist()

    def sampling_tick(
        self, due: Int[Ints, "*any"], uniform: Float[Array, "*any"]
    ) -> Int[Ints, "*any"]:
        """The tick at which a reading is taken that is due at `due`, from uniforms on [0, 1)."""
        off = np.floor(uniform * (2 * self.jitter + 1)).astype(np.int64) - self.jitter
        return np.maximum(due + off, 1)

    def arrival_tick(
        self,
        sampled: Int[Ints, "*any"],
        reading: int | Int[Ints, "*#any"],
        normal: Float[Array, "*any"] | float = 0.0,
    ) -> Int[Ints, "*any"]:
        """The tick at which a reading arrives that was taken at `sampled`.

        A random latency is a normal number, but never negative.

        Args:
            sampled: tick at which it was taken.
            reading: its number, from 0; one number where all rows have the same.
            normal: standard normals.
        """
        late = np.maximum(self.latency + self.latency_std * normal, 0.0)
        out = sampled + np.ceil(late - 1e-6).astype(np.int64)
        if self.history:
            out = np.minimum(out, self.due_tick(reading + self.history - 1) + 1)
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
        if not self._channels:
            yield Instant(
                before * self.timestep, end * self.timestep, self.frame_skip, (), True, end
            )
            return
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
        timing.jitter
        or timing.fractional
        or timing.period % frame_skip
        or timing.phase % frame_skip
    )


def instants(
    channels: Sequence[tuple[str, Timing]], timestep: float, frame_skip: int, duration: float
) -> Instants:
    """The instants of the event loop: every filter step and every sampling time, in order.

    The last filter step ends at the duration, rounded to an integer count of filter steps (at
    least one).

    Args:
        channels: name and timing of each channel.
        timestep: physics step, s.
        frame_skip: physics steps of a filter step.
        duration: s.

    Raises:
        ScenarioError: more than `MOST_INSTANTS`, or a jitter that could change the order of the
            readings.
    """
    _check_count(channels, timestep, frame_skip, duration)
    count = max(1, round(duration / (timestep * frame_skip)))
    schedule = Schedule(channels, timestep, frame_skip, count * frame_skip)
    found = (instant for k in range(count) for instant in schedule.period(k))
    return Instants(found, timestep)


def _check_count(
    channels: Sequence[tuple[str, Timing]], timestep: float, frame_skip: int, duration: float
) -> None:
    """Refuse a run whose instants would not fit into memory, before any of them is made."""
    # What falls on the filter's steps adds no instant, nor does a rhythm that another channel has.
    added = {timing for _, timing in channels if between(timing, frame_skip)}
    rates = [(2 * t.jitter + 1) / (t.fractional[1] if t.fractional else t.period) for t in added]
    ticks = duration / timestep
    steps, count = ticks / frame_skip, ticks * min(1.0, 1 / frame_skip + sum(rates))
    if count > MOST_INSTANTS:
        raise ScenarioError(
            f"duration is {duration:g} s: {steps:.3g} steps of {frame_skip * timestep:g} s, with "
            f"the readings between them {count:.3g} instants, and a run has at most "
            f"{MOST_INSTANTS:,}; it is in seconds: shorten it, or raise model.frame_skip"
        )
