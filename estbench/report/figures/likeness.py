"""Figure of a log beside simulated runs: spectra of the innovations."""

from pathlib import Path

import numpy as np

from estbench.errors import MissingExtraError
from estbench.logs.likeness import Comparison, Spectrum
from estbench.report.figures import palette
from estbench.report.figures.paper import WIDTHS, write

try:
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

HEIGHT = 2.2
"""Inches of one set of axes."""


def draw(found: Comparison, path: Path) -> None:
    """Draw into a file; its suffix is the format.

    Raises:
        EstbenchError: the format is unknown.
    """
    write(lambda: _figure(found), path)


def _figure(found: Comparison) -> Figure:
    """One row for each estimator and component of the reading."""
    rows = [(one.label, spectrum) for one in found.found for spectrum in one.spectra]
    figure = Figure(figsize=(WIDTHS[2], HEIGHT * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), 1, squeeze=False)
    for axes, (label, spectrum) in zip(grid[:, 0], rows):
        _spectrum(axes, spectrum)
        axes.set_title(f"{label}: {spectrum.component}")
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    grid[-1, 0].set_xlabel("frequency, Hz")
    return figure


def _spectrum(axes, spectrum: Spectrum) -> None:
    """The density of ν/σ: of the log, the range and the median of the runs, and white noise."""
    f, runs = spectrum.frequency, spectrum.runs
    axes.fill_between(f, runs.min(axis=1), runs.max(axis=1), color=palette.colour(1), alpha=0.25,
                      lw=0, label="simulated runs")  # fmt: skip
    axes.plot(f, np.median(runs, axis=1), color=palette.colour(1), ls=palette.LINES[1],
              label="median run")  # fmt: skip
    axes.plot(f, spectrum.log, color=palette.colour(0), label="log")
    axes.axhline(2 / spectrum.rate, color=palette.GREY, lw=0.7, label="white")
    axes.set_yscale("log")
    axes.set_ylabel("density of ν/σ, 1/Hz")
