"""An error budget as tables, CSV and JSON."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from estbench.budgets.result import TOGETHER, Budget
from estbench.consistency.intervals import Interval
from estbench.tables import writers
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number, quantity

SMALL = 1e-3
"""Sources whose share is below this in every coordinate are one row of the tables."""
BLOCKS = 10
"""Intervals of time in the table over time."""


def build(budget: Budget, coordinates: Sequence[int], over_time: bool = False) -> list[Table]:
    """The tables of a budget.

    Args:
        budget: with its numbers.
        coordinates: those that are shown.
        over_time: whether a table over time follows for each coordinate.
    """
    tables = [_shares(budget, coordinates)]
    if budget.sampled is not None:
        tables.append(_compared(budget, coordinates))
    if over_time:
        tables += [_over_time(budget, i) for i in coordinates]
    return tables


def _head(budget: Budget, i: int) -> str:
    return f"{budget.names[i]} [{budget.units[i]}]"


def _order(budget: Budget, coordinates: Sequence[int]) -> tuple[list[int], list[int]]:
    """The sources that are shown, the largest share first, and those that are one row."""
    most = np.abs(budget.share[:, coordinates]).max(axis=1)
    order = np.argsort(-most, kind="stable").tolist()
    shown = [i for i in order if most[i] >= SMALL]
    small = [i for i in order if most[i] < SMALL]
    return (shown, small) if len(small) > 1 else (order, [])


def _shares(budget: Budget, coordinates: Sequence[int]) -> Table:
    shown, small = _order(budget, coordinates)
    share, parts = budget.share, [budget.contribution(s) for s in budget.sources]
    variance = np.stack(parts)
    names = [budget.sources[i].name for i in shown]
    rows = [(variance[i], share[i]) for i in shown]
    if small:
        names.append(f"{len(small)} others")
        rows.append((variance[small].sum(axis=0), share[small].sum(axis=0)))
    groups = []
    for c in coordinates:
        sigma = [_sigma(v[c]) for v, _ in rows]
        percent = [f"{100 * p[c]:.1f}%" for _, p in rows]
        sigma += [_sigma(budget.total[c])]
        percent += [f"{100 * sum(p[c] for _, p in rows):.1f}%"]
        if budget.linear is not None:
            sigma.append(_sigma(budget.average(budget.linear.believed)[c]))
            percent.append("")
        head = _head(budget, c)
        narrow = f"σ {budget.names[c]}\n[{budget.units[c]}]"
        columns = (
            Column(f"σ {head}", tuple(sigma), narrow=narrow),
            Column("share", tuple(percent)),
        )
        groups.append(columns)
    ends = ["all", "the filter believes"] if budget.linear is not None else ["all"]
    how = "linear covariance analysis" if budget.linear is not None else "Monte Carlo"
    note = (
        f"σ: root of the mean square error by each source alone, over time after "
        f"{budget.burn_in:g} s and runs; share of the mean square error"
    )
    if any(source is TOGETHER for source in budget.sources):
        note += f"; {TOGETHER.name}: products of errors that are no random numbers"
    return Table(
        (Column("source", (*names, *ends), "left"),), tuple(groups),
        f"{budget.scenario}, {budget.estimator}: error budget by {how}", note,
    )  # fmt: skip


def _compared(budget: Budget, coordinates: Sequence[int]) -> Table:
    """Each source alone and removed, by Monte Carlo, beside the linear one."""
    assert budget.sampled is not None
    sampled, linear = budget.sampled, budget.linear is not None
    alone = {name for what, name in sampled.mse if what == "alone"}
    names = [s.name for s in sampled.sources]
    groups = []
    for c in coordinates:
        own, less, expected = [], [], []
        for s in sampled.sources:
            there = s.name in alone
            own.append(quantity(sampled.alone(s)[c].root()) if there else "–")
            less.append(_signed(sampled.removed(s)[c]))
            average = budget.average(budget.over_time(s))[c]
            expected.append(_sigma(average) if there else "–")
        own += [quantity(sampled.total()[c].root()), _signed(sampled.rest()[c])]
        less += ["", ""]
        expected += [_sigma(budget.total[c]) if linear else "–", ""]
        name, unit = budget.names[c], budget.units[c]
        columns = {"alone": own, "without": less}
        if linear:
            columns = {"linear": expected, **columns}
        for what, cells in columns.items():
            narrow = f"σ {name}\n{what}\n[{unit}]"
            groups.append((Column(f"σ {name} {what} [{unit}]", tuple(cells), narrow=narrow),))
    note = (
        f"{sampled.runs} runs of each variant, on common random numbers; without: root of the "
        "decrease of the mean square error; rest: what the sources do together that they do not "
        f"alone, as a root with its sign; intervals at {sampled.level:.0%}"
    )
    return Table(
        (Column("source", (*names, "all", "rest"), "left"),), tuple(groups),
        f"{budget.scenario}, {budget.estimator}: error budget by Monte Carlo", note,
    )  # fmt: skip


def _over_time(budget: Budget, c: int) -> Table:
    """Averages over intervals of time; by Monte Carlo where there is no linear budget."""
    shown, _ = _order(budget, [c])
    edges = np.linspace(0.0, budget.times[-1], BLOCKS + 1)
    slack = 1e-9 * budget.times[-1]
    members = [(budget.times > a + slack) & (budget.times <= b + slack) for a, b in pairwise(edges)]
    of = budget.over_time if budget.linear is not None else budget.sampled_over_time
    columns = [(budget.sources[i].name, of(budget.sources[i])[:, c]) for i in shown]
    if budget.linear is not None:
        columns.append(("all", budget.linear.total[:, c]))
        columns.append(("believed", budget.linear.believed[:, c]))
    if budget.sampled is not None:
        columns.append(("all, by runs", budget.sampled_over_time(None)[:, c]))
    groups = tuple(
        (Column(name, tuple(_sigma(values[m].mean()) if m.any() else "–" for m in members)),)
        for name, values in columns
    )
    spans = tuple(f"{a:.3g} to {b:.3g}" for a, b in pairwise(edges))
    return Table((Column("time [s]", spans, "left"),), groups, f"σ of {_head(budget, c)} over time")


def to_csv(budget: Budget, coordinates: Sequence[int]) -> str:
    """One line per source and coordinate."""
    return writers.comma_separated(
        ["source", "group", "coordinate", "unit", "std", "share"],
        (
            {
                "source": source.name, "group": source.group, "coordinate": budget.names[c],
                "unit": budget.units[c], "std": _root(budget.contribution(source)[c]),
                "share": float(budget.share[k, c]),
            }
            for k, source in enumerate(budget.sources)
            for c in coordinates
        ),
    )  # fmt: skip


def to_json(budget: Budget, coordinates: Sequence[int]) -> str:
    """All numbers; those over time included."""
    found = budget.dataset().isel(coordinate=list(coordinates))
    return writers.json_of_dataset(found)


def _root(x: float) -> float:
    return float(np.sign(x) * np.sqrt(abs(x)))


def _sigma(x: float) -> str:
    return number(_root(x))


def _signed(i: Interval) -> str:
    """The root of a mean square with its sign, and of both ends."""
    return quantity(Interval(*(_root(x) for x in (i.value, i.low, i.high))))
