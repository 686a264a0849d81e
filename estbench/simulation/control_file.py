"""Controls over time from a CSV file: columns t, then one per actuator."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estbench.errors import ControllerError, DimensionError
from estbench.shapes import Array, Float
from estbench.spaces.patterns import is_number

SHOWN = 30
"""Characters of a cell that a message shows."""
TIME = ("t", "time")
"""Names of the first column."""


def read(
    path: str | None, names: Sequence[str]
) -> tuple[Float[Array, " time"], Float[Array, "time nu"]]:
    """Times, s, and controls of a CSV file, with or without a row of headings.

    A heading that is the name of an actuator, or `t`, must stand at the place of its column; other
    headings are not read.

    Args:
        path: of the file.
        names: of the actuators `(nu,)`, in the order of the columns.

    Raises:
        ControllerError: it cannot be read, or a row of it is wrong: the row is named.
        DimensionError: a row has another count of columns.
    """
    if path is None:
        raise ControllerError("control.path is missing; csv needs the file to read")
    where = f"control.path '{path}'"
    times, controls = list[float](), list[list[float]]()
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            for i, row in enumerate(row for row in reader if row):
                at = f"{where}, row {reader.line_num}"
                if i == 0 and not any(map(is_number, row)):
                    _check_headings(row, names, at)
                    continue
                values = _numbers(row, names, at)
                if times and values[0] <= times[-1]:
                    raise ControllerError(
                        f"{at}: t is {values[0]:g} s after {times[-1]:g} s; the times must increase"
                    )
                times.append(values[0])
                controls.append(values[1:])
    except OSError as error:
        raise ControllerError(f"{where} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ControllerError(f"{where} is not UTF-8 text; use a table of numbers") from None
    except csv.Error as error:
        raise ControllerError(f"{where}, row {reader.line_num} cannot be read: {error}") from None
    if not times:
        raise ControllerError(f"{where} has no row of numbers; give at least one")
    return np.array(times), np.array(controls)


def _check_headings(row: Sequence[str], names: Sequence[str], at: str) -> None:
    """Refuse headings of a wrong count, and a known name at the place of another."""
    _check_count(row, names, at)
    expected = [TIME, *((name,) for name in names)]
    known = {*TIME, *names}
    for column, (cell, own) in enumerate(zip(row, expected), 1):
        heading = cell.strip()
        if heading in known and heading not in own:
            raise ControllerError(
                f"{at}: column {column} is '{heading}'; expected '{own[0]}' (the columns are t, "
                f"{', '.join(names)})"
            )


def _numbers(row: Sequence[str], names: Sequence[str], at: str) -> list[float]:
    """The finite numbers of a row."""
    _check_count(row, names, at)
    values = []
    for name, cell in zip(("t", *names), row):
        value = float(cell) if is_number(cell) else np.nan
        if not np.isfinite(value):
            raise ControllerError(f"{at}: {name} is {_shown(cell)}; use a finite number")
        values.append(value)
    return values


def _check_count(row: Sequence[str], names: Sequence[str], at: str) -> None:
    if len(row) != len(names) + 1:
        raise DimensionError(
            f"{at} has {len(row)} columns; expected {len(names) + 1} (t, {', '.join(names)})"
        )


def _shown(cell: str) -> str:
    return repr(cell if len(cell) <= SHOWN else f"{cell[:SHOWN]}...")
