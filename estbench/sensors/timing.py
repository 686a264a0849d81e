"""Sampling times of channels, arrival times of readings, and the instants of the event loop.

Times are counted in physics steps (ticks). The readings of a channel are due at phase,
phase + period, ...; without a phase the first one is due after one period, because P₀ describes
the knowledge at t = 0. Jitter shifts the sampling time of each reading, in each run, by a random
count of ticks. A reading with latency arrives at the first instant at or after its sampling time
plus the latency; without latency it arrives when it is sampled.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import ScenarioError
from estbench.randomness import streams
from estbench.shapes import Ints

MOST_INSTANTS = 5_000_000
"""Upper limit of the instants per run: 2.5 GB at half a kilobyte each."""


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
class Instant:
    """The end of one interval of the event loop.

    Attributes:
        start, end: s.
        nstep: physics steps between them.
        channels: names of the channels that are due at `end`.
        control: whether the controller is evaluated at `start`.
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

    def due(self, ticks: int) -> Ints:
        """Ticks `(reading,)` at which readings are due up to `ticks`."""
        if self.fractional is None:
            return np.arange(self.phase or self.period, ticks + 1, self.period)
        first, interval = self.fractional
        count = max(0, int((ticks - first) / interval) + 1)
        due = np.ceil(first + interval * np.arange(count) - 1e-6).astype(np.int64)
        return due[due <= ticks]

    def sampled(self, seed: int, runs: Sequence[int], name: str, ticks: int) -> Ints:
        """Ticks `(reading, run)` at which the readings of each run are sampled."""
        due = self.due(ticks)[:, None] + np.zeros(len(runs), np.int64)
        if not self.jitter:
            return due
        z = streams.uniforms(seed, runs, f"sensor:{name}:jitter", len(due), 1)[..., 0]
        off = np.floor(z * (2 * self.jitter + 1)).astype(np.int64) - self.jitter
        return np.clip(due + off, 1, None)

    def arrived(self, sampled: Ints, seed: int, runs: Sequence[int], name: str, ticks: int) -> Ints:
        """Ticks `(reading, run)` at which readings arrive that were sampled at ticks `sampled`.

        A random latency is normally distributed and clipped at 0.
        """
        late = np.full(sampled.shape, self.latency)
        if self.latency_std:
            z = streams.normals(seed, runs, f"sensor:{name}:latency", len(sampled), 1)[..., 0]
            late = np.maximum(late + self.latency_std * z, 0.0)
        out = sampled + np.ceil(late - 1e-6).astype(np.int64)
        if self.history:
            following = self.due(ticks + self.history * (self.period + 1))[self.history - 1 :] + 1
            out = np.minimum(out, following[: len(out), None])
        return out


def instants(
    channels: Sequence[tuple[str, Timing]], timestep: float, frame_skip: int, duration: float
) -> list[Instant]:
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
    """Refuse a run whose instants would not fit into memory, before they are computed."""
    # Readings at the filter's steps add no instant, nor does a second channel of equal timing.
    between = {
        timing
        for _, timing in channels
        if timing.jitter
        or timing.fractional
        or timing.period % frame_skip
        or timing.phase % frame_skip
    }
    rates = [(2 * t.jitter + 1) / (t.fractional[1] if t.fractional else t.period) for t in between]
    ticks = duration / timestep
    steps, count = ticks / frame_skip, ticks * min(1.0, 1 / frame_skip + sum(rates))
    if count > MOST_INSTANTS:
        raise ScenarioError(
            f"duration is {duration:g} s: {steps:.3g} steps of {frame_skip * timestep:g} s, with "
            f"the readings between them {count:.3g} instants, and a run has at most "
            f"{MOST_INSTANTS:,}; it is in seconds: shorten it, or raise model.frame_skip"
        )
