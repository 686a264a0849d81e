"""Figures of an error budget: shares as stacked bars, contributions over time as curves."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estbench.budgets.result import Budget
from estbench.errors import MissingExtraError
from estbench.report.figures import palette
from estbench.report.figures.paper import WIDTHS, write

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

MOST = 6
"""Sources with a colour of their own, and coordinates with curves."""


def draw(budget: Budget, path: Path, coordinates: Sequence[int]) -> None:
    """Draw a budget into a file; its suffix is the format.

    Above: the shares of the mean square error, a stacked bar for each coordinate. Below, where
    there is a linear budget: σ by source over time, with what the filter believes.

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
    curves = coordinates[:MOST] if budget.linear is not None else []
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
    axes.set_xlim(min(0.0, float(below.min())), max(100.0, float(left.max())))
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _curves(axes: Axes, budget: Budget, c: int, named: list[int]) -> None:
    assert budget.linear is not None
    for k, i in enumerate(named):
        values = np.sqrt(np.maximum(budget.over_time(budget.sources[i])[:, c], 0.0))
        style = palette.LINES[k % len(palette.LINES)]
        axes.plot(budget.times, values, color=palette.colour(k), ls=style, lw=0.9)
    axes.plot(budget.times, np.sqrt(budget.linear.total[:, c]), color="black", lw=1.2)
    axes.plot(budget.times, np.sqrt(budget.linear.believed[:, c]), color="black", lw=0.9, ls=":")
    axes.set_yscale("log")
    top = float(np.sqrt(budget.linear.total[:, c].max())) or 1.0
    axes.set_ylim(top / 300, 1.5 * top)
    axes.set_title(f"σ of {budget.names[c]} [{budget.units[c]}]", fontsize=7)
