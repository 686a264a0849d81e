"""A design as tables, CSV and JSON."""

import json
from collections.abc import Sequence
from typing import Any

from estbench.suites.design import Design
from estbench.tables import writers
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number, quantity


def build(found: Design, coordinates: Sequence[int]) -> list[Table]:
    """What each channel is worth, the greedy order, and the suite.

    Args:
        found: with its numbers.
        coordinates: those that are shown.
    """
    return [_worth(found, coordinates), _growing(found, coordinates), _suite(found)]


def required(found: Design) -> list[int]:
    """The coordinates with a requirement."""
    return [i for i, name in enumerate(found.names) if name in found.required]


def _worth(found: Design, coordinates: Sequence[int]) -> Table:
    groups = []
    for i in coordinates:
        name, unit = found.names[i], found.units[i]
        for change, by_channel in found.changed.items():
            cells = (*(number(by_channel[c][i]) for c in found.candidates), number(found.all[i]))
            narrow = f"{name}\n{change}\n[{unit}]"
            groups.append((Column(f"{name} {change} [{unit}]", cells, narrow=narrow),))
    return Table(
        (
            Column("channel", (*found.candidates, "all as they are"), "left"),
            Column("cost", (*(number(found.cost[c]) for c in found.candidates), "")),
        ),
        tuple(groups),
        f"{found.scenario}: σ with all channels and one of them changed",
        "σ: root of the mean variance over time of the best filter; double rate counts as half "
        "the variance of the noise",
    )  # fmt: skip


def _growing(found: Design, coordinates: Sequence[int]) -> Table:
    start = "none" if not found.always else "+".join(found.always)
    names = (start, *(f"+ {name}" for name in found.order))
    groups = [(Column("information [nats]", tuple(number(x) for x in found.information)),)]
    for i in coordinates:
        head = f"σ {found.names[i]} [{found.units[i]}]"
        groups.append((Column(head, tuple(number(s) for s in found.growing[:, i]),
                              narrow=head.replace(" [", "\n[")),))  # fmt: skip
    return Table(
        (Column("channels", names, "left"),), tuple(groups),
        "One channel after the other, each the one that adds most information",
        "k channels in this order have at least 63% of the information that any k can add",
    )  # fmt: skip


def _suite(found: Design) -> Table:
    rows = required(found)
    columns = [
        Column("required σ", tuple(number(found.required[found.names[i]]) for i in rows)),
        Column("predicted σ", tuple(number(found.std[i]) for i in rows)),
    ]
    if found.rmse is not None:
        columns.append(Column("RMSE of the runs", tuple(quantity(found.rmse[i]) for i in rows)))
    best = "the cheapest of all" if found.exhaustive else "found greedily"
    note = f"of the best filter, which estimates the errors of the sensors; {best}"
    if found.rmse is not None:
        note += f"; runs: {found.estimator}, whose verdict is {found.verdict}"
    return Table(
        (
            Column("coordinate", tuple(found.names[i] for i in rows), "left"),
            Column("unit", tuple(found.units[i] for i in rows), "left"),
        ),
        tuple((column,) for column in columns),
        f"The suite: {', '.join(found.chosen) or 'no channel'}; cost {number(found.total_cost)}",
        note,
    )  # fmt: skip


def to_csv(found: Design) -> str:
    """One line per candidate and coordinate."""
    return writers.comma_separated(
        ["channel", "cost", "chosen", "coordinate", "unit", "all", *found.changed],
        (
            {
                "channel": c, "cost": found.cost[c], "chosen": c in found.chosen,
                "coordinate": found.names[i], "unit": found.units[i], "all": float(found.all[i]),
                **{change: float(by[c][i]) for change, by in found.changed.items()},
            }
            for c in found.candidates
            for i in range(len(found.names))
        ),
    )  # fmt: skip


def to_json(found: Design) -> str:
    """All numbers."""
    data: dict[str, Any] = {
        "scenario": found.scenario, "estimator": found.estimator, "coordinates": list(found.names),
        "units": list(found.units), "cost": dict(found.cost), "required": dict(found.required),
        "all": found.all.tolist(),
        "changed": {k: {c: s.tolist() for c, s in by.items()} for k, by in found.changed.items()},
        "order": list(found.order), "information": found.information.tolist(),
        "growing": found.growing.tolist(), "chosen": list(found.chosen),
        "exhaustive": found.exhaustive, "total_cost": found.total_cost, "std": found.std.tolist(),
        "rmse": None if found.rmse is None else [[i.value, i.low, i.high] for i in found.rmse],
        "verdict": found.verdict or None,
    }  # fmt: skip
    return json.dumps(data, indent=2)
