"""Figures of a sweep: lines over one key, maps over two, small multiples over three."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from estbench.consistency.statistics import STATISTICS
from estbench.errors import EstbenchError, MissingExtraError, did_you_mean
from estbench.report.figures import palette
from estbench.report.figures.paper import WIDTHS, write
from estbench.shapes import Array
from estbench.study.design import Study

try:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

DEFAULT = ("anees_over_n", "rmse")
"""The statistics that are drawn, by their names in the Dataset."""
TITLES = {"anees_over_n": "NEES/n", "rmse": "RMSE (geometric mean)", "anis_over_m": "NIS/m"}
HEIGHT = 2.0
"""Inches of one set of axes."""
TICKS = 8
"""Most labels on an axis of a map."""


def draw(study: Study, found: xr.Dataset, path: Path, what: Sequence[str] = DEFAULT) -> None:
    """Draw a sweep into a file; its suffix is the format.

    One key: a line per estimator with intervals. Two: a map per estimator, the region in which the
    verdict is consistent outlined. Three: such a map for each value of the last key. The points of
    a design are drawn as points, the consistent ones with a ring.

    Args:
        study: the varied keys.
        found: as `Findings.dataset` gives it.
        path: the file.
        what: names of statistics in `found`.

    Raises:
        EstbenchError: a statistic is unknown, or there are too many keys to draw.
    """
    check(study, what)
    kind = (_lines, _maps, _multiples)[len(study.axes) - 1]
    write(lambda: kind(study, found, what), path)


def check(study: Study, what: Sequence[str]) -> None:
    """Whether a sweep can be drawn, before it is computed.

    Raises:
        EstbenchError: a statistic is unknown, or there are too many keys to draw.
    """
    known = [s.json_key.replace(".", "_") for s in STATISTICS]
    for name in what:
        if name not in known:
            raise EstbenchError(f"--what '{name}' is not known{did_you_mean(name, known)}")
    if len(study.axes) > 3 or (not study.grid and len(study.axes) > 2):
        most = "three keys of a grid, or two of a design"
        raise EstbenchError(
            f"a figure shows at most {most}, got {len(study.axes)}; leave out --plot, and draw a "
            "part of the Dataset"
        )


def _values(found: xr.Dataset, name: str, estimator: str) -> Array:
    """A statistic `(..., 3)` as value, low, high; over coordinates the geometric mean."""
    parts = [f"{name}{s}" if f"{name}{s}" in found else name for s in ("", "_low", "_high")]
    arrays = [found[part].sel(estimator=estimator) for part in parts]
    if "coordinate" in arrays[0].dims:
        with np.errstate(divide="ignore", invalid="ignore"):
            arrays = [np.exp(xr.apply_ufunc(np.log, a).mean("coordinate")) for a in arrays]
    return np.stack([np.asarray(a.values, np.float64) for a in arrays], axis=-1)


def _numbers(study: Study, axis: int) -> tuple[Array, list[str] | None]:
    """Places of the values on an axis, and their labels where they are no numbers."""
    values = study.axes[axis].values
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return np.asarray(values, np.float64), None
    kinds = list(dict.fromkeys(map(str, values)))
    return np.array([kinds.index(str(v)) for v in values], np.float64), kinds


def _axis(axes: Axes, study: Study, index: int, which: str) -> None:
    """Label and scale of one axis."""
    axis, (_, kinds) = study.axes[index], _numbers(study, index)
    getattr(axes, f"set_{which}label")(axis.key)
    if axis.log:
        getattr(axes, f"set_{which}scale")("log")
    if kinds is not None:
        getattr(axes, f"set_{which}ticks")(range(len(kinds)), kinds)


def _lines(study: Study, found: xr.Dataset, what: Sequence[str]) -> Figure:
    figure = Figure(figsize=(WIDTHS[1], HEIGHT * len(what) + 0.3), layout="constrained")
    x, _ = _numbers(study, 0)
    order = np.argsort(x, kind="stable")
    for axes, name in zip(figure.subplots(len(what), 1, squeeze=False, sharex=True)[:, 0], what):
        every = []
        for i, label in enumerate(study.labels):
            y = _values(found, name, label)[order]
            sides = np.abs(y[:, 1:] - y[:, :1]).T
            axes.errorbar(
                x[order], y[:, 0], np.where(np.isfinite(sides), sides, 0.0), label=label,
                color=palette.colour(i), ls=palette.LINES[i % len(palette.LINES)] if study.grid
                else "none", marker=".", capsize=1.5, elinewidth=0.7,
            )  # fmt: skip
            every.append(y[:, 0])
        _decorate(axes, study, name, np.concatenate(every))
        _axis(axes, study, 0, "x")
        if len(study.labels) > 1:
            axes.legend(frameon=False)
        axes.label_outer()
    return figure


def _decorate(axes: Axes, study: Study, name: str, values: Array) -> None:
    """The name of a statistic, its scale, and for NEES/n the band of the verdict."""
    axes.set_ylabel(TITLES.get(name, name))
    finite = values[np.isfinite(values)]
    if len(finite) and finite.min() > 0 and finite.max() > 5 * finite.min():
        axes.set_yscale("log")
    if name == "anees_over_n":
        tolerance = study.scenario.consistency.tolerance
        axes.axhspan(1 - tolerance, 1 + tolerance, color=palette.GREY, alpha=0.25, lw=0)


def _maps(study: Study, found: xr.Dataset, what: Sequence[str]) -> Figure:
    panels = [
        [(name, label, found.sel(estimator=label), label) for label in study.labels]
        for name in what
    ]
    return _panels(study, found, panels)


def _multiples(study: Study, found: xr.Dataset, what: Sequence[str]) -> Figure:
    last = study.axes[2]
    panels = [
        [
            (what[0], label, found.isel({last.key: i}).sel(estimator=label),
             f"{label}, {last.key} = {value:.3g}" if isinstance(value, float) else
             f"{label}, {last.key} = {value}")
            for i, value in enumerate(last.values)
        ]
        for label in study.labels
    ]  # fmt: skip
    return _panels(study, found, panels)


def _panels(study: Study, found: xr.Dataset, panels: Sequence[Sequence[Any]]) -> Figure:
    """Rows of maps; the maps of one row have one scale of colours."""
    columns = len(panels[0])
    width = WIDTHS[1] if columns == 1 else max(WIDTHS[2], 1.9 * columns)
    figure = Figure(figsize=(width, (HEIGHT + 0.3) * len(panels) + 0.3), layout="constrained")
    grid = figure.subplots(len(panels), columns, squeeze=False, sharex=True, sharey=True)
    for axes, row in zip(grid, panels):
        values = [
            _values(part.expand_dims("estimator"), n, label)[..., 0] for n, label, part, _ in row
        ]
        norm = _norm(np.concatenate([v.ravel() for v in values]))
        drawn: Any = None
        for one, (_, _, part, title), z in zip(axes, row, values):
            good = np.asarray(part["verdict"].values == "consistent")
            drawn = _map(one, study, z, good, norm)
            one.set_title(title)
            one.label_outer()
            one.grid(False)
        figure.colorbar(drawn, ax=list(axes), label=TITLES.get(row[0][0], row[0][0]))
    some = bool((found["verdict"] == "consistent").any())
    note = "outlined: the verdict is consistent" if some else "no verdict is consistent"
    figure.supxlabel(note, fontsize=7)
    return figure


def _norm(values: Array) -> Normalize:
    finite = values[np.isfinite(values)]
    if not len(finite):
        return Normalize(0, 1)
    low, high = finite.min(), finite.max()
    return LogNorm(low, high) if 0 < 5 * low < high else Normalize(low, high)


def _map(axes: Axes, study: Study, z: Array, good: NDArray[np.bool_], norm: Normalize) -> Any:
    """One map with cells of one size, in ascending order, or the points of a design."""
    (x, _), (y, _) = _numbers(study, 0), _numbers(study, 1)
    if not study.grid:
        _axis(axes, study, 0, "x")
        _axis(axes, study, 1, "y")
        axes.scatter(x[good], y[good], s=60, facecolors="none", edgecolors="black", linewidths=1.0)
        return axes.scatter(x, y, c=z, s=22, norm=norm, cmap="viridis")
    order = np.ix_(np.argsort(x, kind="stable"), np.argsort(y, kind="stable"))
    edges = [np.arange(len(v) + 1, dtype=np.float64) - 0.5 for v in (x, y)]
    drawn = axes.pcolormesh(*edges, z[order].T, norm=norm, cmap="viridis")
    _outline(axes, edges, good[order])
    for i, which in enumerate("xy"):
        _cells(axes, study, i, which)
    return drawn


def _cells(axes: Axes, study: Study, index: int, which: str) -> None:
    """The key of one axis of a map, and the values of its cells; of many, some."""
    values, kinds = _numbers(study, index)
    texts = [f"{v:.3g}" for v in np.sort(values)] if kinds is None else kinds
    each = -(-len(texts) // TICKS)
    getattr(axes, f"set_{which}label")(study.axes[index].key)
    getattr(axes, f"set_{which}ticks")(range(0, len(texts), each), texts[::each])


def _outline(axes: Axes, edges: Sequence[Array], good: NDArray[np.bool_]) -> None:
    """Lines around the cells that are good."""
    padded, (x, y) = np.pad(good, 1), edges
    upright = np.argwhere(padded[1:, 1:-1] != padded[:-1, 1:-1])
    level = np.argwhere(padded[1:-1, 1:] != padded[1:-1, :-1])
    lines = [[(x[i], y[j]), (x[i], y[j + 1])] for i, j in upright]
    lines += [[(x[i], y[j]), (x[i + 1], y[j])] for i, j in level]
    for colour, width in (("white", 3.0), ("black", 1.4)):
        axes.add_collection(
            LineCollection(lines, colors=colour, linewidths=width, capstyle="projecting")
        )
