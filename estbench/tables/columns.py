"""Tables that fit their width: what finds no room goes on in a further table under its keys.

No cell is broken in two, so that a long name stays in one piece.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.table import Table
from rich.text import Text

GAP = 2
"""Between columns."""
WIDE = 40
"""A column wider than this is folded where the screen is narrower still."""


@dataclass(frozen=True)
class Column:
    """A heading and what stands under it.

    Attributes:
        heading: of one line.
        cells: one a row.
        justify: `left` for words, `right` for numbers.
        narrow: the heading in several lines, for want of room; default the same.
    """

    heading: str
    cells: tuple[str | Text, ...]
    justify: Literal["left", "right"] = "right"
    narrow: str = ""

    @property
    def width(self) -> int:
        """Of its widest line."""
        cells = (*self.heading.split("\n"), *self.cells)
        return max(cell_len(str(cell)) for cell in cells)

    def narrowed(self) -> "Column":
        """The column under its narrow heading."""
        return replace(self, heading=self.narrow or self.heading)


Group = tuple[Column, ...]
"""Columns that stay beside each other."""


@dataclass(frozen=True)
class Columns:
    """A rich renderable: one table, or as many as it takes.

    Attributes:
        keys: the columns with which every table begins.
        groups: what fills the tables.
    """

    keys: Group
    groups: tuple[Group, ...]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        """The tables for the console's width."""
        yield from (_table(columns) for columns in fit(self.keys, self.groups, options.max_width))


def fit(keys: Group, groups: Sequence[Group], width: int) -> list[Group]:
    """The columns of each table: the keys, and as many groups as find room, at least one.

    Headings are narrow where that saves a table.
    """
    wide = _fill(keys, groups, width)
    narrow = _fill(keys, [tuple(c.narrowed() for c in group) for group in groups], width)
    return narrow if len(narrow) < len(wide) else wide


def _fill(keys: Group, groups: Sequence[Group], width: int) -> list[Group]:
    tables: list[Group] = []
    left = 0
    for group in groups:
        needed = sum(column.width + GAP for column in group)
        if not tables or needed > left:
            tables.append(keys)
            left = width - sum(column.width + GAP for column in keys) + GAP
        tables[-1] += group
        left -= needed
    return tables


def _table(columns: Group) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    for column in columns:
        wide = column.width > WIDE
        heading = Text(column.heading, justify=column.justify)
        table.add_column(heading, justify=column.justify, no_wrap=not wide, overflow="fold")
    for row in zip(*(column.cells for column in columns)):
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table
