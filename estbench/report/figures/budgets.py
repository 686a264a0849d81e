"""Figures of an error budget: shares as stacked bars, contributions over time as curves."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estbench.budgets.result import Budget
from estbench.errors import MissingExtraError
from estbench.report.figures import palette
from estbench.report.figures.paper import WIDTHS, write
from estbench.shapes import Array

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

POINTS = 25
"""Of a Monte Carlo over time."""
MOST = 6
"""Sources with a colour of their own, and coordinates with curves."""


def draw(budget: Budget, path: Path, coordinates: Sequence[int]) -> None:
    """Draw a budget into a file; its suffix is the format.

    Above: the shares of the mean square error, a stacked bar for each coordinate. Below: σ by
    source over time, with what the filter believes; that of a Monte Carlo as points.

    Args:
        budget: to be drawn.
        path: the file.
        coordinates: those that are shown; curves for the first six.
    """
    write(lambda: _figure(budget, list(coordinates)), path)


def _figure(budget: Budget, coordinates: list[int]) -> Figure:
    share = budget.share[:, coordinates]
    order = np.argsort(-np.abs(share).max(axis=1), kind="stable")
    named, others = order[:MOST].tolist(), order[MOST:].tolist()
    curves = coordinates[:MOST]
    rows = -(-len(curves) // 3)
    height = 0.9 + 0.24 * len(coordinates)
    figure = Figure(figsize=(WIDTHS[2], height + 1.5 * rows + 0.3), layout="constrained")
    heights = [height, 1.5 * rows] if rows else [height]
    above, *below = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    _bars(above.subplots(), budget, coordinates, named, others)
    if below:
        columns = min(3, len(curves))
        grid = below[0].subplots(rows, columns, squeeze=False, sharex=True)
        for axes, c in zip(grid.ravel(), curves):
            _curves(axes, budget, c, named)
        for axes in grid.ravel()[len(curves) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
    return figure


def _bars(
    axes: Axes, budget: Budget, coordinates: list[int], named: list[int], others: list[int]
) -> None:
    share = 100 * budget.share[:, coordinates]
    left, below = np.zeros((2, len(coordinates)))
    parts = [(budget.sources[i].name, palette.colour(k), share[i]) for k, i in enumerate(named)]
    if others:
        parts.append((f"{len(others)} others", "#c0c0c0", share[others].sum(axis=0)))
    places = np.arange(len(coordinates))
    for name, colour, values in parts:
        start = np.where(values >= 0, left, below)
        axes.barh(places, values, left=start, color=colour, label=name, height=0.75)
        left += np.maximum(values, 0.0)
        below += np.minimum(values, 0.0)
    axes.set_yticks(places, [budget.names[c] for c in coordinates])
    axes.invert_yaxis()
    axes.grid(False)
    axes.set_xlabel("share of the mean square error [%]")
    axes.set_title(f"{budget.scenario}, {budget.estimator}")
    if budget.linear is not None:  # of the curves below
        axes.plot([], [], color="black", lw=1.2, label="all")
        axes.plot([], [], color="black", lw=0.9, ls=":", label="believed")
    if budget.sampled is not None:
        axes.plot([], [], color="black", ls="none", marker=".", ms=3, label="all, by runs")
    axes.set_xlim(min(0.0, float(below.min())), max(100.0, float(left.max())))
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _curves(axes: Axes, budget: Budget, c: int, named: list[int]) -> None:
    lines = [(budget.over_time(budget.sources[i]), palette.colour(k),
              palette.LINES[k % len(palette.LINES)], 0.9) for k, i in enumerate(named)]  # fmt: skip
    if budget.linear is not None:
        lines.append((budget.linear.total, "black", "-", 1.2))
        lines.append((budget.linear.believed, "black", ":", 0.9))
    for values, colour, style, width in lines:
        axes.plot(budget.times, _root(values[:, c]), color=colour, ls=style, lw=width)
    points = [(budget.sampled_over_time(budget.sources[i]), palette.colour(k))
              for k, i in enumerate(named)]  # fmt: skip
    points.append((budget.sampled_over_time(None), "black"))
    some = slice(None, None, max(1, len(budget.times) // POINTS))
    for values, colour in points:
        axes.plot(budget.times[some], _root(values[some, c]), color=colour, ls="none", marker=".",
                  ms=2)  # fmt: skip
    axes.set_yscale("log")
    known = budget.sampled_over_time(None) if budget.linear is None else budget.linear.total
    top = float(np.sqrt(np.nanmax(known[:, c]))) or 1.0
    axes.set_ylim(top / 300, 1.5 * top)
    axes.set_title(f"σ of {budget.names[c]} [{budget.units[c]}]", fontsize=7)


def _root(variance: Array) -> Array:
    return np.sqrt(np.maximum(variance, 0.0))
