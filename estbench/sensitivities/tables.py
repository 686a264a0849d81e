"""A sensitivity analysis as tables, CSV and JSON."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.consistency.intervals import Interval
from estbench.sensitivities.indices import OUTPUTS, Indices
from estbench.sensitivities.parameter import Parameter
from estbench.sensitivities.ranges import End
from estbench.sensitivities.result import Curve, Sensitivity
from estbench.tables import writers
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number, quantity


def build(found: Sensitivity, coordinates: Sequence[int]) -> list[Table]:
    """The tables of a sensitivity analysis.

    Args:
        found: with its numbers.
        coordinates: those whose own elasticities are shown.
    """
    tables = [_elasticities(found, coordinates)]
    if found.curves:
        tables.append(_curves(found))
    if found.ranges:
        tables.append(_ranges(found))
    if found.indices is not None:
        tables.append(_indices(found, found.indices))
    return tables


def _named(parameters: Sequence[Parameter]) -> Column:
    return Column("parameter", tuple(p.key for p in parameters), "left")


def _elasticities(found: Sensitivity, coordinates: Sequence[int]) -> Table:
    slopes = found.slopes
    keys = (
        _named([s.parameter for s in slopes]),
        Column("value", tuple(s.parameter.shown() for s in slopes)),
        Column("varied by", tuple(_factors(s.factors) for s in slopes)),
    )
    groups = [
        (Column("RMSE", tuple(quantity(s.rmse) for s in slopes)),),
        (Column("NEES", tuple(quantity(s.nees) for s in slopes)),),
    ]
    for c in coordinates:
        name = f"RMSE {found.names[c]}"
        cells = tuple(quantity(s.each[c]) for s in slopes)
        groups.append((Column(name, cells, narrow=name.replace(" ", "\n")),))
    note = (
        "elasticities: the percentage by which RMSE (geometric mean over the coordinates) and NEES "
        f"change with 1% more of the parameter; {found.runs} runs of each variant on common random "
        f"numbers, intervals at {found.level:.0%}; filter..., start..., estimators...: the filter "
        "alone changes; the others: robot and filter alike"
    )
    return Table(keys, tuple(groups), f"{found.scenario}, {found.estimator}: sensitivity", note)


def _factors(factors: tuple[float, float]) -> str:
    """`÷1.1, x1.1`; a factor of 1 is left out."""
    shown = [f"÷{1 / f:.3g}" if f < 1 else f"x{f:.3g}" for f in factors if f != 1]
    return ", ".join(shown)


def _curves(found: Sensitivity) -> Table:
    rows = [
        (curve, k)
        for curve in found.curves
        for k in range(len(curve.factors))
        if np.isfinite(curve.factors[k])
    ]
    columns = (
        Column("RMSE", tuple(f"{_cell(c.rmse[k])} x" for c, k in rows)),
        Column("NEES/n", tuple(_cell(c.nees[k]) for c, k in rows)),
        Column("diverged", tuple(_percent(c, k) for c, k in rows)),
    )
    keys = (
        _named([c.parameter for c, _ in rows]),
        Column("value", tuple(c.parameter.shown(float(c.factors[k])) for c, k in rows)),
    )
    note = "RMSE: over that of the scenario as it is; of the runs that did not diverge"
    return Table(keys, tuple((c,) for c in columns), "Over a wide range", note)


def _cell(x: float) -> str:
    return number(float(x), 3)


def _percent(curve: Curve, k: int) -> str:
    share = curve.diverged[k]
    return f"{share:.1%}" if np.isfinite(share) else "–"


def _ranges(found: Sensitivity) -> Table:
    """One row per end."""
    ends = [(p, end, low) for p, *both in found.ranges for end, low in zip(both, (True, False))]
    keys = (
        _named([p for p, *_ in ends]),
        Column("consistent", tuple(_end(*end) for end in ends)),
    )
    columns = (
        Column("NEES/n", tuple(_cell(end.nees) for _, end, _ in ends)),
        Column("confirmed", tuple("yes" if end.confirmed else "no" for _, end, _ in ends)),
        Column("beyond", tuple(end.verdict or "–" for _, end, _ in ends), "left"),
        Column("NEES/n beyond", tuple(_cell(end.nees_beyond) for _, end, _ in ends),
               narrow="NEES/n\nbeyond"),
        Column("reason", tuple(end.reason for _, end, _ in ends), "left", wraps=True),
    )  # fmt: skip
    note = (
        "all else as it is; beyond: the verdict at the next value that was tried, within 3%; ≤, ≥: "
        "the search ends there; NEES/n and confirmed: by as many runs with other random numbers"
    )
    told = columns if any(end.reason for _, end, _ in ends) else columns[:-1]
    return Table(keys, tuple((c,) for c in told), "Where the verdict stays consistent", note)


def _end(p: Parameter, end: End, low: bool) -> str:
    sign = ("≤" if low else "≥") if end.beyond is None else ""
    return f"{'from' if low else 'to'} {sign}{p.shown(end.factor)}"


def _indices(found: Sensitivity, own: Indices) -> Table:
    groups = []
    for k, output in enumerate(OUTPUTS):
        for what, values in (("first order", own.first), ("total", own.total)):
            cells = tuple(quantity(Interval(*map(float, row))) for row in values[k])
            groups.append((Column(f"{output} {what}", cells, narrow=f"{output}\n{what}"),))
    keys = (_named(own.parameters), Column("range", own.ranges))
    note = (
        f"Sobol indices: the share of the variance of log RMSE (std {number(own.std[0])}) and log "
        f"NEES/n (std {number(own.std[1])}) over all ranges that each parameter causes alone, and "
        f"with its interactions; {own.points} scenarios, bootstrap intervals at {found.level:.0%}"
    )
    return Table(keys, tuple(groups), "Which ones matter together", note)


def to_csv(found: Sensitivity, coordinates: Sequence[int]) -> str:
    """One line per parameter: its elasticities."""
    columns = ["parameter", "side", "value", "low_factor", "high_factor"]
    ends = ("", "_low", "_high")
    columns += [f"{n}{e}" for n in ("rmse", "nees") for e in ends]
    columns += [f"rmse {found.names[c]}{e}" for c in coordinates for e in ends]
    rows = []
    for s in found.slopes:
        row: dict[str, Any] = {
            "parameter": s.parameter.key, "side": s.parameter.side, "value": s.parameter.shown(),
            "low_factor": s.factors[0], "high_factor": s.factors[1],
        }  # fmt: skip
        named = {"rmse": s.rmse, "nees": s.nees}
        named |= {f"rmse {found.names[c]}": s.each[c] for c in coordinates}
        for name, i in named.items():
            row |= {f"{name}{e}": v for e, v in zip(ends, (i.value, i.low, i.high))}
        rows.append(row)
    return writers.comma_separated(columns, rows)


def to_json(found: Sensitivity) -> str:
    """All numbers."""
    return writers.json_of_dataset(found.dataset())
