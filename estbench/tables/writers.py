"""Tables as text, Markdown and LaTeX, and rows as CSV.

A table without columns is the heading of a section.
"""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, RenderableType
from rich.text import Text

from estbench.spaces.patterns import is_number
from estbench.tables.columns import Table
from estbench.tables.names import visible

if TYPE_CHECKING:
    import xarray as xr

FORMULAS = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a cell that a spreadsheet takes for a formula."""


def text(tables: Sequence[Table], width: int = 100) -> str:
    """For a terminal of `width` characters; columns that do not fit go on in a table below."""
    parts: list[RenderableType] = []
    for table in tables:
        parts.append(Text(f"{table.title}:" if table.columns else table.title))
        parts += [table] if table.columns else []
        parts += [Text(table.note)] if table.note else []
        parts.append("")
    return printed(*parts, width=width).rstrip()


def printed(*parts: RenderableType, width: int = 100) -> str:
    """What rich prints for a terminal of `width` characters, without colours."""
    console = Console(width=width, no_color=True, force_terminal=False, highlight=False)
    with console.capture() as capture:
        for part in parts:
            console.print(part)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def markdown(tables: Sequence[Table]) -> str:
    """Pipe tables under headings of the third level."""
    parts = []
    for table in tables:
        if not table.columns:
            parts.append(f"## {table.title}")
            continue
        headings = [c.heading for c in table.columns]
        rule = ["---:" if c.justify == "right" else "---" for c in table.columns]
        rows = [[text.replace("|", "\\|") for text in row] for row in table.rows]
        lines = ["| " + " | ".join(row) + " |" for row in (headings, rule, *rows)]
        parts.append("\n".join([f"### {table.title}", "", *lines]))
        if table.note:
            parts.append(table.note)
    return "\n\n".join(parts)


def latex(tables: Sequence[Table]) -> str:
    """`table` environments with booktabs rules; a section's heading is a comment."""
    parts = ["% \\usepackage{booktabs}"]
    for table in tables:
        if not table.columns:
            parts.append(f"% {table.title}")
            continue
        sides = "".join(c.justify[0] for c in table.columns)
        headings = [c.heading for c in table.columns]
        head, *rows = (" & ".join(map(escape, row)) + r" \\" for row in (headings, *table.rows))
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


def comma_separated(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV with a line of headings; a row's cell is empty where it has no such key.

    A text that a spreadsheet would take for a formula begins with a quote.
    """
    file = io.StringIO()
    writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
    return file.getvalue()


def _cell(value: Any) -> Any:
    """A value as CSV shows it."""
    if not isinstance(value, str):
        return value
    quote = "'" if value.startswith(FORMULAS) and not is_number(value) else ""
    return quote + visible(value)


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "±": r"$\pm$", "σ": r"$\sigma$", "µ": r"$\mu$", "ν": r"$\nu$", "×": r"$\times$",
    "²": r"$^2$", "∞": r"$\infty$", "<": r"$<$", ">": r"$>$", "–": "--",
}  # fmt: skip


def escape(text: str) -> str:
    """Text for LaTeX."""
    return "".join(_LATEX.get(c, c) for c in text)


def json_of_dataset(found: "xr.Dataset") -> str:
    """The attributes, coordinates, dimensions and values of a Dataset; null where not finite."""
    data = {name: _plain(v.values) for name, v in found.data_vars.items()}
    coords = {name: np.asarray(v.values).tolist() for name, v in found.coords.items()}
    dims = {str(name): list(v.dims) for name, v in found.data_vars.items()}
    return json.dumps(
        {**found.attrs, "coordinates": coords, "dimensions": dims, "values": data}, indent=2
    )


def _plain(values: Any) -> Any:
    """Numbers of JSON, which has no NaN."""
    out = np.asarray(values, object)
    out[~np.isfinite(values)] = None
    return out.tolist()
