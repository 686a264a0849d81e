"""A statistic's value as a cell of a table, and as the plain numbers of JSON."""

import math
from collections.abc import Iterable
from typing import Any

from estbench.consistency.declaration import Detail, Statistic
from estbench.consistency.intervals import Interval
from estbench.consistency.statistics import RMSE, Summary
from estbench.tables.quantity import number, percent, quantity

LOST = "*"
"""After the RMSE of an estimator that lost runs, in a cell."""
LOST_NOTE = f"{LOST} leaves out the runs that diverged"


def marked(text: str, summary: Summary) -> str:
    """The text of an RMSE, with `LOST` where the estimator lost runs."""
    return text + LOST if summary.diverged > 0 and text != "–" else text


def lost_note(summaries: Iterable[Summary]) -> tuple[str, ...]:
    """The note that explains `LOST`; none where no estimator lost runs."""
    return (LOST_NOTE,) if any(s.diverged > 0 for s in summaries) else ()


def of_summary(
    summary: Summary, statistic: Statistic, value: Interval | float, detail: Detail
) -> str:
    """The text of one value of an estimator, marked where it leaves out lost runs."""
    text = cell(statistic, value, detail)
    return marked(text, summary) if statistic is RMSE else text


def cell(statistic: Statistic, value: Interval | float, detail: Detail) -> str:
    """The text of one value.

    Args:
        statistic: says the form.
        value: of one estimator, or of one of its coordinates.
        detail: with its interval or without; a number has none.
    """
    if not isinstance(value, Interval):
        return number(value, statistic.decimals, tiny=True)
    if statistic.form == "share":
        return percent(value) if detail == "full" else share(value.value)
    return quantity(value) if detail == "full" else number(value.value, statistic.decimals)


def share(x: float) -> str:
    """A share in percent: `2.0%`; `–` for NaN."""
    return f"{x:.1%}" if math.isfinite(x) else "–"


def value_of(summary: Summary, statistic: Statistic) -> Any:
    """The value of a statistic: an interval or a number, or one of these per coordinate."""
    return getattr(summary, statistic.name)


def estimate(value: Interval | float) -> float:
    """The value without its interval."""
    return float(value.value if isinstance(value, Interval) else value)


def plain(value: Interval | float) -> Any:
    """For JSON: an interval as an object, a number as itself; None where it is not finite."""
    if isinstance(value, Interval):
        return {"value": plain(value.value), "low": plain(value.low), "high": plain(value.high)}
    return float(value) if math.isfinite(value) else None


def per_coordinate(
    summary: Summary, statistics: Iterable[Statistic], names: Iterable[str], units: Iterable[str]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Statistics of each coordinate for JSON: key -> coordinate -> unit and numbers.

    The key `a.b` puts the number `b` into the objects of the key `a`.

    Args:
        summary: of one estimator.
        statistics: those that have a value per coordinate.
        names: of the coordinates `(n,)`.
        units: theirs `(n,)`.
    """
    coordinates = list(zip(names, units))
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for statistic in statistics:
        key, _, child = statistic.json_key.partition(".")
        table = out.setdefault(key, {name: {"unit": unit} for name, unit in coordinates})
        for (name, _), value in zip(coordinates, value_of(summary, statistic)):
            found = plain(value)
            table[name] |= (
                {child: found} if child else found if isinstance(found, dict) else {"value": found}
            )
    return out
