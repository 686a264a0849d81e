"""Tables that fit their width: columns without room go on in a further table beside the same keys.

No cell is broken across lines, except in a column wider than `WIDE` or one of sentences.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.table import Table as RichTable
from rich.text import Text

from estbench.tables.names import visible

GAP = 2
"""Characters between columns."""
WIDE = 40
"""A column wider than this is folded where it does not fit the console."""


@dataclass(frozen=True)
class Column:
    """A heading and the cells under it; control characters in names become escapes.

    Attributes:
        heading: one line.
        cells: one per row.
        justify: `left` for words, `right` for numbers.
        narrow: the heading where columns are scarce, perhaps of several lines; default the same.
        wraps: whether its cells may take several lines, for sentences.
    """

    heading: str
    cells: tuple[str | Text, ...]
    justify: Literal["left", "right"] = "right"
    narrow: str = ""
    wraps: bool = False

    def __post_init__(self) -> None:
        shown = tuple(visible(c) if isinstance(c, str) else c for c in self.cells)
        object.__setattr__(self, "cells", shown)
        for name in ("heading", "narrow"):
            object.__setattr__(self, name, visible(getattr(self, name), lines=True))

    @property
    def width(self) -> int:
        """Characters of its widest line."""
        cells = (*self.heading.split("\n"), *self.cells)
        return max(cell_len(str(cell)) for cell in cells)

    def narrowed(self) -> "Column":
        """The column with its narrow heading."""
        return replace(self, heading=self.narrow or self.heading)


Group = tuple[Column, ...]
"""Columns that stay in one table."""


@dataclass(frozen=True)
class Table:
    """A table as one value: text, Markdown, LaTeX and rich consoles show it.

    For a console it is a rich renderable, of one table or as many as it takes, without title and
    note: what prints it chooses their style.

    Attributes:
        keys: the columns with which every table begins.
        groups: the other columns; those of one group stay beside each other.
        title: what it shows.
        note: how to read it.
    """

    keys: Group
    groups: tuple[Group, ...]
    title: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", visible(self.title))
        object.__setattr__(self, "note", visible(self.note, lines=True))

    @property
    def columns(self) -> Group:
        """All columns in order."""
        return sum(self.groups, self.keys)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """The cells of each row, without their style."""
        return [tuple(map(str, row)) for row in zip(*(c.cells for c in self.columns))]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RichTable]:
        """The tables for the console's width."""
        yield from (_table(columns) for columns in fit(self.keys, self.groups, options.max_width))


def tabulate(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], note: str = ""
) -> Table:
    """A table from its rows. The keys reach up to its last column of words or of units.

    Args:
        title: what it shows.
        headings: one that starts with `<` is of words, the others are of numbers.
        rows: as many cells each as there are headings.
        note: how to read it.
    """
    columns = tuple(
        Column(
            text := heading.removeprefix("<"), tuple(row[i] for row in rows),
            "left" if heading.startswith("<") else "right", text.replace(" ", "\n"),
        )
        for i, heading in enumerate(headings)
    )  # fmt: skip
    words = [i for i, c in enumerate(columns) if c.justify == "left" or c.heading == "unit"]
    keys = 1 + max(words, default=0)
    return Table(columns[:keys], tuple((column,) for column in columns[keys:]), title, note)


def fit(keys: Group, groups: Sequence[Group], width: int) -> list[Group]:
    """The columns of each table: the keys, and as many groups as fit, at least one.

    Narrow headings are taken where they save a table.

    Args:
        keys: columns of every table.
        groups: the other columns.
        width: characters.
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
    return tables or [keys]


def _table(columns: Group) -> RichTable:
    table = RichTable(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    for column in columns:
        wraps = column.wraps or column.width > WIDE
        heading = Text(column.heading, justify=column.justify)
        table.add_column(heading, justify=column.justify, no_wrap=not wraps, overflow="fold")
    for row in zip(*(column.cells for column in columns)):
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table
