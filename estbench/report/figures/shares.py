"""Figures of the page for error budgets: shares as stacked bars, contributions over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from estbench.budgets.result import Budget
from estbench.report.budgets import EntryBudget
from estbench.report.figures import data, palette
from estbench.report.figures.data import thin
from estbench.report.figures.drawing import Drawing, axes, drawing
from estbench.shapes import Array

MOST = 6
"""Sources with a colour of their own."""


def drawings(budgets: Sequence[EntryBudget]) -> list[Drawing]:
    """One figure of bars for each entry, and for each coordinate one of its curves.

    A source has the same colour in all of them; those with the largest shares have one.
    """
    largest: dict[str, float] = {}
    for b in budgets:
        for source, share in zip(b.sources, b.shares):
            largest[source.name] = max(largest.get(source.name, 0.0), float(np.abs(share).max()))
    named = sorted(largest, key=lambda name: -largest[name])[:MOST]
    out = []
    for b in budgets:
        if b.found is not None:
            out.append(_bars(b, b.found, named))
            out += [_curves(b, b.found, named, i) for i in range(len(b.found.names))]
    return out


def _bars(b: EntryBudget, found: Budget, named: Sequence[str]) -> Drawing:
    share = {s.name: 100 * values for s, values in zip(b.sources, b.shares)}
    parts = [
        (name, palette.colour(k), share[name]) for k, name in enumerate(named) if name in share
    ]
    others = [values for name, values in share.items() if name not in named]
    if others:
        parts.append((f"{len(others)} others", "#c0c0c0", np.sum(others, axis=0)))
    traces = [
        go.Bar(
            x=values, y=list(found.names), orientation="h", name=name, marker={"color": colour},
            showlegend=True, meta={"entry": b.key, "always": True},
            hovertemplate=f"{name}: %{{x:.1f}}%<extra>%{{y}}</extra>",
        )
        for name, colour, values in parts
    ]  # fmt: skip
    layout: dict[str, Any] = dict(axes("share of the mean square error (%)", ""))
    layout |= {"barmode": "relative", "showlegend": True}
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    height = 150 + 22 * len(found.names)
    return drawing(f"budget-{b.index}", f"{b.key}: shares of the sources", traces, layout, height)


def _curves(b: EntryBudget, found: Budget, named: Sequence[str], c: int) -> Drawing:
    assert found.linear is not None  # the report asks for no Monte Carlo
    meta = {"entry": b.key}
    lines = [
        (s.name, found.over_time(s)[:, c], palette.colour(k), palette.dash(k), 1.3)
        for s in found.sources if s.name in named for k in [named.index(s.name)]
    ]  # fmt: skip
    lines.append(("all", found.linear.total[:, c], palette.GREY, "solid", 2.0))
    lines.append(("believed", found.linear.believed[:, c], palette.GREY, "2px,3px", 1.4))
    traces = []
    for name, variance, colour, dash, width in lines:
        sigma = _sigma(variance)
        keep = thin(sigma, data.POINTS // 2)
        traces.append(
            go.Scatter(
                x=found.times[keep], y=sigma[keep], mode="lines", name=name, showlegend=False,
                line={"color": colour, "dash": dash, "width": width}, meta=meta,
            )
        )  # fmt: skip
    layout = axes("time (s)", found.units[c], type="log", **_range(found, c))
    return drawing(f"budget-{b.index}-{c}", f"{b.key}: σ of {found.names[c]} by source", traces,
                   layout, 230, time=True, coordinate=c)  # fmt: skip


def _range(found: Budget, c: int) -> dict[str, list[float]]:
    """Three decades below the largest error, as logarithms."""
    assert found.linear is not None
    top = float(_sigma(found.linear.total[:, c]).max())
    return {"range": [np.log10(top) - 2.5, np.log10(top) + 0.1]} if top > 0 else {}


def _sigma(variance: Array) -> Array:
    return np.sqrt(np.maximum(variance, 0.0))
