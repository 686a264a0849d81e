"""Time stamps of a log in s since its start, and in ticks of 1 ns."""

import numpy as np

from estbench.errors import LogError
from estbench.logs.table import LogTable
from estbench.shapes import Array, Float, Int, Ints

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Length of the units of time stamps, s."""
NAMES = ("time", "t", "timestamp", "stamp", "time_s", "header.stamp", "received",
         "0")  # fmt: skip
"""Headings of a column of time stamps, the first that there is is taken."""
TICK = 1e-9
"""s."""


def find(table: LogTable, name: str | None) -> str:
    """The name of the column of time stamps.

    Raises:
        LogError: none is named, and no column has a usual name.
    """
    if name is not None:
        return name
    known = {column.strip().lower(): column for column in table.columns}
    for usual in NAMES:
        if usual in known:
            return known[usual]
    raise LogError(
        f"{table.title} has no column of time stamps by one of the names {', '.join(NAMES)}; name "
        f"one of {', '.join(table.columns)} by log.time"
    )


def stamps(
    table: LogTable, name: str, unit: str, key: str, rows: Int[Ints, " k"]
) -> Float[Array, " k"]:
    """The time stamps of a column in some rows, s.

    Raises:
        LogError: the column is missing, or a stamp is no finite number.
    """
    values = table.column(name, key)[rows] * SECONDS[unit]
    wrong = np.flatnonzero(~np.isfinite(values))
    if len(wrong):
        raise LogError(
            f"{table.at(int(rows[wrong[0]]))}: the time stamp in column '{name}' is missing or not "
            "finite; remove the row"
        )
    return values


def ticks(seconds: Float[Array, "*any"]) -> Int[Ints, "*any"]:
    """Times since the start of the log, in ns."""
    return np.round(seconds / TICK).astype(np.int64)
