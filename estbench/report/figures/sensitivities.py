"""Figures of a sensitivity: a tornado plot of the elasticities, curves of some parameters."""

from pathlib import Path

import numpy as np

from estbench.consistency.intervals import Interval
from estbench.errors import MissingExtraError
from estbench.report.figures import palette
from estbench.report.figures.paper import WIDTHS, write
from estbench.sensitivities.result import Curve, Sensitivity

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

MOST = 24
"""Parameters in the tornado plot."""
COLOURS = {"filter": palette.colour(1), "hardware": palette.colour(0)}
LEGEND = {"filter": "the filter alone changes", "hardware": "robot and filter alike"}
HEIGHT = 1.7
"""Inches of one row of curves."""


def draw(found: Sensitivity, path: Path) -> None:
    """Draw a sensitivity analysis into a file; its suffix is the format.

    Above a tornado plot: the elasticities of RMSE and NEES, the largest first, with intervals.
    Below it, where there are curves: RMSE and NEES/n over the factor of each parameter.
    """
    write(lambda: _figure(found), path)


def _figure(found: Sensitivity) -> Figure:
    height = 0.9 + 0.17 * min(len(found.slopes), MOST)
    rows = 1 if found.curves else 0
    figure = Figure(figsize=(WIDTHS[2], height + HEIGHT * rows), layout="constrained")
    heights = [height, HEIGHT][: 1 + rows]
    above, *below = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    left, right = above.subplots(1, 2, sharey=True)
    _tornado(left, found, "rmse", "d log RMSE / d log θ")
    _tornado(right, found, "nees", "d log NEES / d log θ")
    left.set_yticks(
        range(len(found.slopes[:MOST])), [s.parameter.key for s in found.slopes[:MOST]], fontsize=6
    )
    left.invert_yaxis()
    left.set_title(f"{found.scenario}, {found.estimator}")
    sides = dict.fromkeys(s.parameter.side for s in found.slopes[:MOST])
    parts = [Patch(color=COLOURS[side], label=LEGEND[side]) for side in sides]
    figure.legend(handles=parts, frameon=False, loc="outside upper right", ncols=2, fontsize=6)
    if below:
        _curves(below[0].subplots(1, 2), found)
    return figure


def _tornado(axes: Axes, found: Sensitivity, name: str, label: str) -> None:
    shown = found.slopes[:MOST]
    values: list[Interval] = [getattr(s, name) for s in shown]
    middle = np.array([i.value for i in values])
    half = np.nan_to_num([(i.high - i.low) / 2 for i in values], posinf=0.0)
    axes.barh(
        range(len(shown)), np.nan_to_num(middle), xerr=half, height=0.72,
        color=[COLOURS[s.parameter.side] for s in shown],
        error_kw={"elinewidth": 0.7, "ecolor": "black", "capsize": 1.2, "capthick": 0.7},
    )  # fmt: skip
    axes.axvline(0.0, color="black", lw=0.6)
    axes.set_xlabel(label)
    axes.grid(visible=False, axis="y")


def _curves(pair: tuple[Axes, Axes], found: Sensitivity) -> None:
    """RMSE beside NEES/n; both over the factor."""
    for axes, name in zip(pair, ("rmse", "nees")):
        for k, curve in enumerate(found.curves):
            axes.plot(
                curve.factors, getattr(curve, name), label=_label(curve), marker=".",
                color=palette.colour(k), ls=palette.LINES[k % len(palette.LINES)], lw=0.9, ms=3,
            )  # fmt: skip
        axes.set_xscale("log")
        if name == "nees":
            axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis)[: 2 if name == "nees" else 1]:
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(ScalarFormatter())
            axis.set_minor_locator(NullLocator())
        axes.set_xlabel("θ over its value [1]")
        axes.axvline(1.0, color=palette.GREY, lw=0.6)
    pair[0].set_ylabel("RMSE over that at θ [1]")
    pair[1].set_ylabel("NEES/n [1]")
    pair[1].axhline(1.0, color=palette.GREY, lw=0.6)
    pair[1].legend(frameon=False, fontsize=6)


def _label(curve: Curve) -> str:
    return curve.parameter.key
