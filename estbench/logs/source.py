"""A log as a source of readings and controls for the event loop: one run, at its own times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import LogError
from estbench.logs import clock, controls, readings
from estbench.logs.readings import ChannelReadings
from estbench.logs.table import LogTable
from estbench.logs.truth import Truth
from estbench.scenario.log import LogSection
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery
from estbench.sensors.timing import Instant
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class Log:
    """A log, mapped to the channels and controls of a robot.

    Attributes:
        channels: readings of each channel, in the measurement's order.
        start: by the log's clock, s; the times below are from it on.
        instants: the intervals between the times at which something is taken or arrives.
        u: controls over each of them `(instant, nu)`.
        lateness: longest time from taking to arrival, ticks.
        notices: what looks wrong.
        truth: at the start and the instants, in its own frame; None where the log has none.
    """

    channels: tuple[ChannelReadings, ...]
    start: float
    instants: tuple[Instant, ...]
    u: Float[Array, "time-1 nu"]
    lateness: int
    notices: tuple[str, ...]
    truth: Truth | None = None

    @property
    def duration(self) -> float:
        """From the start to the last instant, s."""
        return self.instants[-1].end


def mapped(
    tables: Sequence[LogTable],
    section: LogSection,
    spaces: dict[str, Manifold],
    actuators: Sequence[str],
    rest: Float[Array, " nu"],
    window: float | None,
) -> Log:
    """The log by `[log]`.

    Args:
        tables: its files.
        section: `[log]`.
        spaces: channel -> the manifold of its readings.
        actuators: their names.
        rest: controls of actuators that the log does not have.
        window: `filter.window`, s; None where it is not given.

    Raises:
        LogError: the log does not fit the robot, or something of it is missing; file, row and time
            are named.
    """
    _check_twice(section)
    every = [
        readings.readings(tables, section, name, section.channels[name], space)
        for name, space in spaces.items()
    ]
    notices = [
        text
        for part in every
        if (text := readings.suspicious(part, section.channels[part.name], spaces[part.name]))
    ]
    signals = controls.held(tables, section, actuators)
    begin = min(float(part.taken.min()) for part in every)
    begin = min([begin, *(float(s.times[0]) - section.delay for s in signals)]) + section.skip
    end = np.inf if section.duration is None else begin + section.duration
    chosen = tuple(_between(part, begin, end) for part in every)
    longest = _check_order(chosen, section, window)
    stamped = [np.concatenate([p.taken, p.arrived]) for p in chosen]
    if section.instants == "all":
        stamped += [s.times[(s.times > begin) & (s.times <= end)] for s in signals]
    times = np.concatenate(stamped) - begin
    ticks, first = np.unique(clock.ticks(times), return_index=True)
    ends = times[first]
    if ticks[-1] <= 0:
        raise LogError(f"{chosen[0].table.title}: all readings have one time stamp; a log has more")
    before = np.concatenate([[0.0], ends])
    u = controls.over(signals, rest, before + begin)
    instants = tuple(
        Instant(float(a), float(b), 0, (), True, int(tick))
        for a, b, tick in zip(before, ends, ticks)
    )
    return Log(chosen, begin, instants, u, longest, tuple(notices))


def _check_twice(section: LogSection) -> None:
    """Refuse a column that two channels have."""
    owner = dict[str, str]()
    for name, part in section.channels.items():
        for column in part.columns:
            if column in owner:
                raise LogError(
                    f"log.channels.{name}: column '{column}' is mapped to '{owner[column]}' already"
                )
            owner[column] = name


def _between(part: ChannelReadings, begin: float, end: float) -> ChannelReadings:
    """The readings that are taken and arrive from `begin` to `end`.

    Raises:
        LogError: there is none.
    """
    here = (part.taken >= begin) & (part.arrived <= end)
    if not here.any():
        raise LogError(
            f"{part.table.title}: channel '{part.name}' has no reading from t = {begin:.9g} to "
            f"{end:.9g} s; change log.skip or log.duration"
        )
    return ChannelReadings(
        part.name, part.table, part.rows[here], part.taken[here], part.arrived[here],
        part.y[here], part.missing,
    )  # fmt: skip


def _check_order(
    channels: Sequence[ChannelReadings], section: LogSection, window: float | None
) -> int:
    """The longest time from taking to arrival, in ticks.

    Raises:
        LogError: a time stamp goes back by more than the window.
    """
    longest = 0
    for part in channels:
        late = clock.ticks(part.arrived - part.taken)
        longest = max(longest, int(late.max()))
        if section.channels[part.name].taken is not None:
            continue  # the log says when it arrived: what comes too late is counted
        known = section.channels[part.name].latency
        allowed = max(window or 0.0, known, 0.0)
        wrong = np.flatnonzero(late > clock.ticks(np.array(allowed)) + 1)
        if len(wrong):
            at = int(wrong[0])
            back = float(part.arrived[at] - part.taken[at])
            limit = (
                "filter.window is not given" if window is None else f"filter.window is {window:g} s"
            )
            raise LogError(
                f"{part.table.at(int(part.rows[at]), float(part.taken[at]))}: the time stamp goes "
                f"back by {back:.4g} s and filter.window is {limit}; raise it, or sort the log"
            )
    return longest


class LogSource:
    """The source of one run that a log gives; its truth is not known.

    Args:
        log: mapped.
        fused: the channels that are given to the estimator.
    """

    def __init__(self, log: Log, fused: Sequence[str]):
        self.x0: Float[Array, "run nx"] | None = None
        self.events: Sequence[Event] = [Event(i.tick, i) for i in log.instants]
        self._u = log.u[:, None]
        place = {event.tick: k for k, event in enumerate(self.events)}
        self._arrive: list[list[Delivery]] = [[] for _ in self.events]
        for part in log.channels:
            if part.name not in fused:
                continue
            taken = clock.ticks(part.taken - log.start).tolist()
            arrived = clock.ticks(part.arrived - log.start).tolist()
            for k, (when, tick) in enumerate(zip(taken, arrived)):
                delivery = Delivery((part.name,), when, part.y[k : k + 1], None, when)
                self._arrive[place[tick]].append(delivery)

    def control(self, k: int, estimate: Float[Array, "run nx"]) -> Float[Array, "run nu"]:
        """The control of the log."""
        return self._u[k]

    def advance(self, k: int, u: Float[Array, "run nu"]) -> tuple[None, list[Delivery]]:
        """What arrives."""
        return None, self._arrive[k]
