"""A file of a log as columns of numbers, and the row of the file that each number is from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estbench.errors import LogError, did_you_mean
from estbench.shapes import Array, Float, Int, Ints

SHOWN = 30
"""Characters of a cell that a message shows."""


@dataclass(frozen=True, eq=False)
class LogTable:
    """The columns of one file.

    Attributes:
        path: of the file.
        columns: name -> numbers; NaN where a cell is empty.
        rows: number of each row in the file, from 1, as an editor shows it; of each message in its
            topic.
        topic: of a bag.
        texts: name -> row and cell of the first entry that is no number, of columns that have one.
    """

    path: Path
    columns: Mapping[str, Float[Array, " row"]]
    rows: Int[Ints, " row"]
    texts: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    topic: str = ""

    @property
    def title(self) -> str:
        """The file, and the topic of a bag, for a message."""
        return f"{self.path} {self.topic}".strip()

    def column(self, name: str, key: str) -> Float[Array, " row"]:
        """The numbers of a column.

        Args:
            name: of the column.
            key: of the scenario, that asks for it.

        Raises:
            LogError: there is no such column, or an entry of it is no number.
        """
        if name in self.texts:
            row, cell = self.texts[name]
            raise LogError(
                f"{self.title}, row {row}: column '{name}' has {shown_cell(cell)}; {key} needs "
                "numbers"
            )
        if name not in self.columns:
            raise LogError(
                f"{self.title} has no column '{name}', which {key} names"
                f"{did_you_mean(name, self.columns)}"
            )
        return self.columns[name]

    def at(self, index: int, time: float | None = None) -> str:
        """The place of an entry for a message: file, row, and the time stamp in s."""
        when = "" if time is None else f", t = {time:.9g} s"
        return f"{self.title}, row {int(self.rows[index])}{when}"


def shown_cell(cell: str) -> str:
    """A cell in a message."""
    return repr(cell if len(cell) <= SHOWN else f"{cell[:SHOWN]}...")


def from_arrays(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> LogTable:
    """The table of named arrays; the columns of a matrix `a` are `a[0]`, `a[1]`, ....

    Raises:
        LogError: the arrays differ in length, or there are none.
    """
    columns: dict[str, Array] = {}
    for name, values in arrays.items():
        if values.ndim not in (1, 2) or values.dtype.kind not in "fiub":
            continue
        numbers = np.asarray(values, np.float64)
        if numbers.ndim == 1:
            columns[name] = numbers
        else:
            columns |= {f"{name}[{i}]": column for i, column in enumerate(numbers.T)}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise LogError(
            f"{path}: its arrays differ in length ({listed}); give one file for each time base"
        )
    count = next(iter(lengths.values()), 0)
    if not count:
        raise LogError(f"{path} is empty: it has no row of numbers")
    return LogTable(path, columns, np.arange(1, count + 1))
