"""The controls of a log: their mean over any interval, however they are held."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import LogError, did_you_mean
from estbench.logs import clock
from estbench.logs.readings import scaled, table_with
from estbench.logs.table import LogTable
from estbench.scenario.log import LogColumns, LogSection
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask

USUAL_INTERVALS = 10
"""Intervals for which a control is held at most, unless the scenario says how long."""
SPARSE = 0.9
"""A file of which a smaller share of the rows has a control gives it beside faster readings."""


@dataclass(frozen=True, eq=False)
class Held:
    """The controls of one entry of `[log.controls]`.

    Attributes:
        places: of its actuators among all.
        times: from when on each value counts, s by the log's clock, rising `(k,)`.
        values: `(k, c)`.
        hold: as `LogSection.hold`.
        longest: s for which the first and the last value count outside of the times.
        table, rows: where they are from.
    """

    places: Int[Ints, " c"]
    times: Float[Array, " k"]
    values: Float[Array, "k c"]
    hold: str
    longest: float
    table: LogTable
    rows: Int[Ints, " k"]

    def mean(self, ends: Float[Array, " time"]) -> Float[Array, "time-1 c"]:
        """The mean over each interval between two times; the value itself where it is constant."""
        start, end = ends[:-1], ends[1:]
        total = self._integral(ends)
        length = np.where(end > start, end - start, 1.0)[:, None]
        mean = (total[1:] - total[:-1]) / length
        if self.hold == "linear":
            return np.where((end > start)[:, None], mean, self._at(end))
        value, constant = self._constant(start, end)
        return np.where((constant | (end <= start))[:, None], value, mean)

    def _constant(self, start: Array, end: Array) -> tuple[Array, Bool[Mask, " interval"]]:
        """The value at the start of each interval, and whether it is held to its end."""
        first = np.searchsorted(self.times, start, "right")
        last = np.searchsorted(self.times, end, "left")
        shift = 1 if self.hold == "previous" else 0
        value = self.values[np.clip(first - shift, 0, len(self.times) - 1)]
        return value, np.asarray(last <= first)

    def _at(self, t: Array) -> Array:
        return np.column_stack([np.interp(t, self.times, column) for column in self.values.T])

    def _integral(self, t: Array) -> Array:
        """The integral of the held controls from the first time to each t."""
        gaps = np.diff(self.times)[:, None]
        left, right = self.values[:-1], self.values[1:]
        area = {"previous": left, "next": right, "linear": (left + right) / 2}[self.hold] * gaps
        whole = np.concatenate([np.zeros((1, self.values.shape[1])), np.cumsum(area, axis=0)])
        k = np.clip(np.searchsorted(self.times, t, "right") - 1, 0, len(self.times) - 1)
        after = (t - self.times[k])[:, None]
        nearest = np.minimum(k + 1, len(self.times) - 1)
        level = {
            "previous": self.values[k],
            "next": self.values[np.where(after[:, 0] < 0, 0, nearest)],
            "linear": (self.values[k] + self._at(t)) / 2,
        }[self.hold]
        return whole[k] + level * after


def held(tables: Sequence[LogTable], log: LogSection, names: Sequence[str]) -> list[Held]:
    """The controls that the log has.

    Args:
        tables: the files of the log.
        log: the section `[log]`.
        names: of the actuators.

    Raises:
        LogError: an actuator is not known or has two columns, or a control is no finite number.
    """
    found, taken = [], dict[str, str]()
    for name, section in log.controls.items():
        key = f"log.controls.{name}"
        if name not in names:
            raise LogError(f"{key}: there is no actuator '{name}'{did_you_mean(name, names)}")
        if len(section.columns) != 1:
            raise LogError(f"{key}.columns is {section.columns}; an actuator has one column")
        column = section.columns[0]
        if column in taken:
            raise LogError(f"{key}: column '{column}' is mapped to '{taken[column]}' already")
        taken[column] = name
        found.append(_held(tables, log, section, key, names.index(name)))
    return found


def _held(
    tables: Sequence[LogTable], log: LogSection, section: LogColumns, key: str, place: int
) -> Held:
    table = table_with(tables, section.columns, key)
    values = scaled(table, section, key)
    known = np.asarray(np.isfinite(values).all(axis=1))
    rows = np.flatnonzero(known)
    stamped = clock.find(table, log.time)
    wrong = np.flatnonzero(~known)
    if len(wrong) and known.mean() > SPARSE:
        time = clock.stamps(table, stamped, log.unit, "log.time", wrong[:1])
        raise LogError(
            f"{table.at(int(wrong[0]), float(time[0]))}: the control in column "
            f"'{section.columns[0]}' is missing; give a number, or remove the row"
        )
    if not len(rows):
        raise LogError(f"{table.title}: {key} has no number in column '{section.columns[0]}'")
    times = np.full(len(known), np.nan)
    times[rows] = clock.stamps(table, stamped, log.unit, "log.time", rows) + log.delay
    order = rows[np.argsort(times[rows], kind="stable")]
    # Of equal stamps the last counts.
    last = np.append(np.diff(times[order]) > 0, True)
    order = order[last]
    usual = float(np.median(np.diff(times[order]))) if len(order) > 1 else 0.0
    longest = USUAL_INTERVALS * usual if log.longest_hold is None else log.longest_hold
    return Held(np.array([place]), times[order], values[order], log.hold, longest, table, order)


def over(
    found: Sequence[Held], rest: Float[Array, " nu"], ends: Float[Array, " time"]
) -> Float[Array, "time-1 nu"]:
    """All controls over the intervals between the times.

    Args:
        found: of `held`.
        rest: what an actuator has that the log does not have.
        ends: times by the log's clock, s.

    Raises:
        LogError: controls begin too late or end before the readings.
    """
    out = np.repeat(rest[None], len(ends) - 1, axis=0)
    for part in found:
        last, first = float(part.times[-1]), float(part.times[0])
        if ends[-1] > last + part.longest:
            raise LogError(
                f"{part.table.at(int(part.rows[-1]), last)}: the controls end here and the "
                f"readings go on to t = {ends[-1]:.9g} s; give log.duration or log.longest_hold"
            )
        if ends[0] < first - part.longest:
            raise LogError(
                f"{part.table.at(int(part.rows[0]), first)}: the controls begin here and the "
                f"readings at t = {ends[0]:.9g} s; give log.skip or log.longest_hold"
            )
        out[:, part.places] = part.mean(ends)
    return out
