"""Tables that know nothing of what they show, and how text, Markdown and LaTeX write them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from rich.console import Console

from estbench.consistency.nees import Interval
from estbench.tables.columns import Column, Columns


@dataclass(frozen=True)
class Table:
    """Cells as they are shown.

    Attributes:
        title: what it is.
        columns: headings; one that starts with `<` is of words, the others are of numbers.
        rows: as many cells each as there are columns.
        note: how to read it.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    @property
    def headings(self) -> tuple[str, ...]:
        """The headings without their mark."""
        return tuple(c.removeprefix("<") for c in self.columns)

    def side(self, column: int) -> Literal["left", "right"]:
        """Where a column is aligned: words left, numbers right."""
        return "left" if self.columns[column].startswith("<") else "right"


def text(tables: Sequence[Table], width: int = 100) -> str:
    """For a terminal of so many columns; columns that do not fit go on in a table below."""
    console = Console(width=width, no_color=True, force_terminal=False, highlight=False)
    with console.capture() as capture:
        for table in tables:
            console.print(f"{table.title}:" if table.columns else table.title, markup=False)
            if table.columns:
                console.print(_drawn(table))
            if table.note:
                console.print(table.note, markup=False)
            console.print()
    return "\n".join(line.rstrip() for line in capture.get().splitlines()).rstrip()


def _drawn(table: Table) -> Columns:
    """The table in as many as fit; what its rows are called stands in each."""
    columns = [
        Column(heading, tuple(cells), table.side(i), heading.replace(" ", "\n"))
        for i, (heading, *cells) in enumerate(zip(table.headings, *table.rows))
    ]
    keys = 1 + max(
        i for i, c in enumerate(table.columns) if i == 0 or c.startswith("<") or c == "unit"
    )
    return Columns(tuple(columns[:keys]), tuple((column,) for column in columns[keys:]))


def markdown(tables: Sequence[Table]) -> str:
    """Pipe tables under headings of the third level."""
    parts = []
    for table in tables:
        if not table.columns:
            parts.append(f"## {table.title}")
            continue
        rule = ["---:" if table.side(i) == "right" else "---" for i in range(len(table.columns))]
        rows = [[cell.replace("|", "\\|") for cell in row] for row in table.rows]
        lines = ["| " + " | ".join(row) + " |" for row in ([*table.headings], rule, *rows)]
        parts.append("\n".join([f"### {table.title}", "", *lines]))
        if table.note:
            parts.append(table.note)
    return "\n\n".join(parts)


def latex(tables: Sequence[Table]) -> str:
    """`table` environments with booktabs rules, a comment where a section begins."""
    parts = ["% \\usepackage{booktabs}"]
    for table in tables:
        if not table.columns:
            parts.append(f"% {table.title}")
            continue
        sides = "".join(table.side(i)[0] for i in range(len(table.columns)))
        head, *rows = (
            " & ".join(map(escape, row)) + r" \\" for row in (table.headings, *table.rows)
        )
        caption = escape(f"{table.title}. {table.note}".replace("\n", " ").strip())
        parts.append(
            "\n".join(
                [
                    r"\begin{table}", r"\centering", rf"\caption{{{caption}}}",
                    rf"\begin{{tabular}}{{{sides}}}", r"\toprule", head, r"\midrule", *rows,
                    r"\bottomrule", r"\end{tabular}", r"\end{table}",
                ]
            )
        )  # fmt: skip
    return "\n\n".join(parts)


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "±": r"$\pm$", "σ": r"$\sigma$", "µ": r"$\mu$", "ν": r"$\nu$", "×": r"$\times$",
    "²": r"$^2$", "∞": r"$\infty$", "<": r"$<$", ">": r"$>$", "–": "--",
}  # fmt: skip


def escape(cell: str) -> str:
    """Text for LaTeX."""
    return "".join(_LATEX.get(c, c) for c in cell)


def bounds(i: Interval, decimals: int = 3) -> str:
    """`1.021 [1.013, 1.030]`: for an interval that is not symmetric."""
    if np.isnan(i.value):
        return "–"
    low, high = (f"{x:.{decimals}f}" if abs(x) < 1e4 else f"{x:.2g}" for x in (i.low, i.high))
    return f"{number(i.value, decimals)} [{low}, {high}]".replace("inf", "∞")


def percent(i: Interval, decimals: int = 1) -> str:
    """`2.0% [0.8, 5.0]`."""
    if np.isnan(i.value):
        return "–"
    value, low, high = (f"{100 * x:.{decimals}f}" for x in (i.value, i.low, i.high))
    return f"{value}% [{low}, {high}]"


def number(x: float, decimals: int | None = None) -> str:
    """A number, or a sign where there is none."""
    if not np.isfinite(x):
        return "–" if np.isnan(x) else "∞" if x > 0 else "-∞"
    if decimals is None and 999.5 <= abs(x) < 1e6:
        return f"{x:.0f}"
    return f"{x:.3g}" if decimals is None or abs(x) >= 1e4 else f"{x:.{decimals}f}"


def probability(p: float) -> str:
    """A p-value."""
    return "–" if np.isnan(p) else "<0.001" if p < 0.001 else f"{p:.3f}"
