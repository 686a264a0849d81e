"""A log as text: the delimiter, the row of headings and the decimal sign are found out."""

import csv
from pathlib import Path

import numpy as np

from estbench.errors import LogError
from estbench.logs.table import LogTable
from estbench.spaces.patterns import is_number

DELIMITERS = ("\t", ";", ",", "|", " ")
"""In the order in which they are tried: a comma may be the decimal sign beside the others."""
LOOKED_AT = 50
"""Lines from which the form of a file is found out."""


def read(path: Path) -> LogTable:
    """The columns of a text file.

    Lines that begin with `#` are not read, but for one just before the numbers with as many words
    as these have columns: it has the headings. Columns without a heading are `0`, `1`, ....

    Raises:
        LogError: it cannot be read, has no row of numbers, or a row has another count of cells.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise LogError(f"{path} is not UTF-8 text; use CSV, TSV or npz") from None
    numbered = [(i, line) for i, line in enumerate(lines, 1) if line.strip()]
    body = [(i, line) for i, line in numbered if not line.lstrip().startswith("#")]
    if not body:
        raise LogError(f"{path} is empty: it has no row of numbers")
    delimiter = _delimiter([line for _, line in body[:LOOKED_AT]])
    comma = delimiter != "," and any("," in line for _, line in body[1:LOOKED_AT])
    cells = [_cells(line, delimiter, path, i) for i, line in body]
    names, first = _headings(cells, comma), 1
    if names is None:
        names, first = _commented(numbered, body[0][0], delimiter, len(cells[0])), 0
    rows = [i for i, _ in body[first:]]
    if not rows:
        raise LogError(f"{path} is empty: it has headings and no row of numbers")
    _check_headings(path, names)
    for i, row in zip(rows, cells[first:]):
        if len(row) != len(names):
            cut = "; the file ends here: is it cut off?" if i == rows[-1] else ""
            raise LogError(
                f"{path}, row {i} has {len(row)} cells; expected {len(names)} ({', '.join(names)})"
                f"{cut}"
            )
    columns, texts = {}, {}
    for name, column in zip(names, zip(*cells[first:])):
        values, wrong = _numbers(column, comma)
        if wrong is None:
            columns[name] = values
        else:
            texts[name] = rows[wrong], column[wrong]
    return LogTable(path, columns, np.array(rows), texts)


def _delimiter(lines: list[str]) -> str:
    """The first delimiter by which all lines have the same count of cells, above one."""
    for delimiter in DELIMITERS:
        counts = [len(line.strip().split(None if delimiter == " " else delimiter))
                  for line in lines]  # fmt: skip
        whole = counts[:-1] or counts  # the last line may be cut off
        if min(whole) == max(whole) > 1:
            return delimiter
    best = {d: sum(line.count(d) for line in lines) for d in DELIMITERS[:-1]}
    return max(best, key=lambda d: best[d]) if any(best.values()) else ","


def _cells(line: str, delimiter: str, path: Path, row: int) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
    except csv.Error as error:
        raise LogError(f"{path}, row {row} cannot be read: {error}") from None


def _headings(cells: list[list[str]], comma: bool) -> list[str] | None:
    """The first row, if no cell of it is a number and none is empty."""
    first = cells[0]
    if any(not cell or is_number(_dotted(cell, comma)) for cell in first):
        return None
    return first


def _commented(
    numbered: list[tuple[int, str]], begin: int, delimiter: str, count: int
) -> list[str]:
    """Headings in the comment before the first row of numbers, else the columns' numbers."""
    before = [line for i, line in numbered if i < begin]
    if before:
        text = before[-1].lstrip().lstrip("#").strip()
        for separator in (None if delimiter == " " else delimiter, None, ","):
            words = [word.strip() for word in text.split(separator)]
            if len(words) == count and not any(map(is_number, words)):
                return words
    return [str(i) for i in range(count)]


def _check_headings(path: Path, names: list[str]) -> None:
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise LogError(f"{path} has two columns '{twice[0]}'; give each its own heading")


def _numbers(column: tuple[str, ...], comma: bool) -> tuple[np.ndarray, int | None]:
    """The numbers of a column, NaN for an empty cell, and the first cell that is no number."""
    out = np.full(len(column), np.nan)
    for i, cell in enumerate(column):
        if cell:
            text = _dotted(cell, comma)
            if not is_number(text):
                return out, i
            out[i] = float(text)
    return out, None


def _dotted(cell: str, comma: bool) -> str:
    return cell.replace(",", ".") if comma else cell
