"""The clocks of many rows: each starts when an episode of its row begins, all tick together."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estbench.sensors.timing import Instant, Schedule
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask


class Event(NamedTuple):
    """Some rows go on for one interval.

    Attributes:
        tick: physics steps since the simulation began, at the interval's end.
        instant: the interval by the rows' own clocks; by the first row's, where they differ.
        rows: those that go on `(row,)`; None is all.
    """

    tick: int
    instant: Instant
    rows: Bool[Mask, " row"] | None = None


class Clocks:
    """Where each row is in its episode.

    Args:
        rows: how many.
        schedule: the instants of an episode.
        timed: whether anything depends on the time: then only rows of one clock go on together.

    Attributes:
        tick: physics steps since the simulation began.
        shared: whether all rows are on one clock.
    """

    def __init__(self, rows: int, schedule: Schedule, timed: bool = False):
        self._schedule, self._timed = schedule, timed
        self._begin = np.zeros(rows, np.int64)
        self.tick, self.shared = 0, True

    @property
    def elapsed(self) -> Int[Ints, " row"]:
        """Physics steps since each row's episode began `(row,)`."""
        return self.tick - self._begin

    def start(self, rows: Int[Ints, " k"]) -> None:
        """Begin episodes in some rows, by their numbers."""
        self._begin[rows] = self.tick
        self.shared = bool((self._begin == self._begin[0]).all())

    def interval(self, nstep: int, rows: Bool[Mask, " row"] | None = None) -> list[Event]:
        """One interval of a given length for some rows, whatever the schedule says."""
        timestep, skip = self._schedule.timestep, self._schedule.frame_skip
        if self.shared and self._schedule.plain and nstep == skip:
            k, rest = divmod(self.tick - int(self._begin[0]), skip)
            if not rest:  # as usual: the schedule has this instant
                self.tick += skip
                return [Event(self.tick, self._schedule.period(k)[0], rows)]
        out = []
        for mask in self._groups(rows):
            first = 0 if mask is None else int(mask.argmax())
            before = self.tick - int(self._begin[first])
            after = before + nstep
            instant = Instant(before * timestep, after * timestep, nstep, (), False, after)
            out.append(Event(self.tick + nstep, instant, mask))
        self.tick += nstep
        return out

    def period(self, rows: Bool[Mask, " row"] | None = None) -> list[Event]:
        """The intervals of one control period of some rows, in the order of time."""
        skip = self._schedule.frame_skip
        if self._schedule.plain:
            return self.interval(skip, rows)
        if self.shared:
            begin = int(self._begin[0])
            instants = self._schedule.period((self.tick - begin) // skip)
            self.tick += skip
            return [Event(begin + i.tick, i, rows) for i in instants]
        out = []
        for mask, instants in self._patterns(rows):
            first = instants[0].tick - instants[0].nstep
            out += [Event(self.tick + i.tick - first, i, mask) for i in instants]
        self.tick += skip
        return sorted(out, key=lambda event: event.tick)

    def time(
        self, event: Event
    ) -> tuple[float | Float[Array, "row 1"], float | Float[Array, "row 1"]]:
        """Start and end of an event by each row's own clock, s; numbers where it is the same."""
        if self.shared:
            return event.instant.start, event.instant.end
        end = (event.tick - self._begin)[:, None].astype(np.float64)
        timestep = self._schedule.timestep
        return (end - event.instant.nstep) * timestep, end * timestep

    def _groups(self, rows: Mask | None) -> Iterator[Mask | None]:
        """The rows, or, where the time matters, those of each clock."""
        if not self._timed or self.shared:
            yield rows
            return
        for begin in np.unique(self._begin if rows is None else self._begin[rows]):
            here = self._begin == begin
            yield here if rows is None else here & rows

    def _patterns(self, rows: Mask | None) -> Iterator[tuple[Mask | None, tuple[Instant, ...]]]:
        """Rows whose instants lie alike in this control period, and these instants."""
        numbers = self.elapsed // self._schedule.frame_skip
        for group in self._groups(rows):
            found: dict[tuple[int, ...], tuple[Mask, tuple[Instant, ...]]] = {}
            for k in np.unique(numbers if group is None else numbers[group]).tolist():
                instants = self._schedule.period(k)
                here = numbers == k if group is None else (numbers == k) & group
                key = tuple(i.nstep for i in instants)
                before = found.get(key)
                found[key] = (here, instants) if before is None else (before[0] | here, before[1])
            for mask, instants in found.values():
                yield (None if mask.all() else mask), instants
