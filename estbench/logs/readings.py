"""The readings of a channel as a log has them: values in the unit of the channel, and times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import LogError
from estbench.logs import clock, units
from estbench.logs.table import LogTable
from estbench.scenario.log import LogChannel, LogColumns, LogSection
from estbench.shapes import Array, Float, Int, Ints
from estbench.spaces.manifold import Manifold

TOO_LARGE = {"rad": 30.0, "rad/s": 200.0}
"""Magnitudes above which readings look like degrees."""


@dataclass(frozen=True, eq=False)
class ChannelReadings:
    """What one channel measured, in the order of the log.

    Attributes:
        name: of the channel.
        table: the file that they are from.
        rows: index of each reading in the rows of the table `(k,)`.
        taken: when each was taken, s by the log's clock `(k,)`.
        arrived: when each was known, not before the one before it `(k,)`.
        y: values in SI units `(k, ny)`; +inf where a component is missing.
        missing: rows of the table without a reading.
    """

    name: str
    table: LogTable
    rows: Int[Ints, " k"]
    taken: Float[Array, " k"]
    arrived: Float[Array, " k"]
    y: Float[Array, "k ny"]
    missing: int


def table_with(tables: Sequence[LogTable], columns: Sequence[str], key: str) -> LogTable:
    """The one file that has all these columns.

    Raises:
        LogError: none has them, or several.
    """
    found = [t for t in tables if all(c in t.columns or c in t.texts for c in columns)]
    if not found:
        nearest = max(tables, key=lambda t: sum(c in t.columns for c in columns))
        for name in columns:
            nearest.column(name, key)  # raises: it names the column
    if len(found) > 1:
        listed = ", ".join(str(t.path) for t in found[:3])
        raise LogError(
            f"{key}: the columns {', '.join(columns)} are in several files ({listed}); replay the "
            "logs one by one"
        )
    return found[0]


def scaled(table: LogTable, section: LogColumns, key: str) -> Float[Array, "row axis"]:
    """The columns in SI units: scale unit raw + offset.

    Raises:
        LogError: a column or the unit is not known, or the offset has another count of axes.
    """
    raw = np.column_stack([table.column(name, key) for name in section.columns])
    offset = np.atleast_1d(np.asarray(section.offset, np.float64))
    if len(offset) not in (1, raw.shape[1]):
        raise LogError(
            f"{key}.offset is {section.offset}; give one number, or one for each of the "
            f"{raw.shape[1]} columns"
        )
    factor = section.scale * units.factor(section.unit, key)
    return raw * factor + offset if factor != 1 or offset.any() else raw


def readings(
    tables: Sequence[LogTable], log: LogSection, name: str, section: LogChannel, space: Manifold
) -> ChannelReadings:
    """The readings of one channel.

    Args:
        tables: the files of the log.
        log: the section `[log]`.
        name: of the channel.
        section: `[log.channels.NAME]`.
        space: of its readings.

    Raises:
        LogError: the columns do not fit the channel, or none of its readings is there.
    """
    key = f"log.channels.{name}"
    if len(section.columns) != space.nx:
        raise LogError(
            f"{key}.columns has {len(section.columns)} columns; the channel has {space.nx} "
            f"({', '.join(space.names)})"
        )
    table = table_with(tables, section.columns, key)
    y = scaled(table, section, key)
    come = np.isfinite(y)
    # A quaternion has come as a whole or not at all.
    here = come.any(axis=1) if space.flat else come.all(axis=1)
    rows = np.flatnonzero(here)
    if not len(rows):
        raise LogError(
            f"{table.title} has no reading of channel '{name}' in column "
            f"{', '.join(section.columns)}; leave it out of log.channels"
        )
    stamped = clock.find(table, section.time or log.time)
    where = f"{key}.time" if section.time else "log.time"
    times = clock.stamps(table, stamped, log.unit, where, rows)
    taken = times - section.latency if section.latency else times
    if section.taken is not None:
        taken = clock.stamps(table, section.taken, log.unit, f"{key}.taken", rows)
    arrived = np.maximum.accumulate(np.maximum(times, taken))
    y = np.where(come, y, np.inf)[rows]
    return ChannelReadings(name, table, rows, taken, arrived, y, int((~here).sum()))


def suspicious(found: ChannelReadings, section: LogColumns, space: Manifold) -> str | None:
    """A warning where angles look like degrees, with the evidence."""
    for i, unit in enumerate(space.units):
        if section.unit is not None or unit not in TOO_LARGE or not space.flat:
            continue
        values = found.y[:, i]
        largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
        if largest > TOO_LARGE[unit]:
            degrees = unit.replace("rad", "deg")
            return (
                f"channel '{found.name}': column '{section.columns[i]}' reaches {largest:.4g}, and "
                f"its unit is taken to be {unit}; if it is {degrees}, give "
                f'log.channels.{found.name}.unit = "{degrees}"'
            )
    return None
