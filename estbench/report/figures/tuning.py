"""Figures of a tuning: the profile of each parameter, and the trace of the search."""

from pathlib import Path

import numpy as np

from estbench.errors import MissingExtraError, StudyError
from estbench.report.figures import palette
from estbench.report.figures.paper import WIDTHS, write
from estbench.tuning.result import Tuned

try:
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

HEIGHT = 1.7
"""Inches of one set of axes."""
WIDE = 20.0
"""Ratio of the ends of a profile above which its axis is logarithmic."""


def draw(tuned: Tuned, path: Path) -> None:
    """Draw profiles and trace into a file; its suffix is the format.

    Raises:
        StudyError: the search kept no trace.
        EstbenchError: the format is unknown.
    """
    if not tuned.trace:
        raise StudyError("there is nothing to draw: the search was interrupted at its start")
    write(lambda: _figure(tuned), path)


def _figure(tuned: Tuned) -> Figure:
    """One row per parameter: its profile, its way through the search; the loss below."""
    rows = len(tuned.parameters) + 1
    figure = Figure(figsize=(WIDTHS[2], HEIGHT * rows), layout="constrained")
    grid = figure.subplots(rows, 2, squeeze=False)
    counts = [step.candidates for step in tuned.trace]
    for i, parameter in enumerate(tuned.parameters):
        left, right = grid[i]
        if tuned.profiles:
            _profile(left, tuned, i)
        else:
            left.set_axis_off()
        values = [step.values[i] for step in tuned.trace]
        if parameter.kind == "choice":
            values = [str(v) for v in values]
        right.plot(counts, values, marker=".", color=palette.colour(0))
        right.set_title(parameter.key)
        if parameter.log:
            right.set_yscale("log")
    below, aside = grid[-1]
    best = np.minimum.accumulate([step.loss for step in tuned.trace])
    gap = best - tuned.loss[1]
    below.plot(counts, np.where(gap > 0, gap, np.nan), marker=".", color=palette.colour(0))
    if (gap > 0).any():
        below.set_yscale("log")
    below.set_ylabel("loss per run")
    below.set_title("loss above that of the end")
    below.set_xlabel("candidates")
    grid[-2, 1].set_xlabel("candidates")
    aside.set_axis_off()
    return figure


def _profile(axes, tuned: Tuned, index: int) -> None:
    profile, parameter = tuned.profiles[index], tuned.parameters[index]
    axes.plot(profile.values, profile.loss, marker=".", color=palette.colour(0), label="profile")
    if np.isfinite(profile.expected).all():
        axes.plot(
            profile.values, profile.expected, color=palette.colour(1), ls=palette.LINES[1],
            label="curvature",
        )  # fmt: skip
    axes.axvline(tuned.values[index], color=palette.GREY, lw=0.7)
    if parameter.log and profile.values.max() > WIDE * profile.values.min():
        axes.set_xscale("log")
    axes.set_title(parameter.key)
    axes.set_ylabel("loss of all runs")
    axes.legend(frameon=False)
