"""`estbench plot`: the report's figures for papers, with matplotlib, one or two columns wide."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy import stats

from estbench.consistency.coverage import EXPECTED, SIGMAS
from estbench.errors import EstbenchError, MissingExtraError, StoreError, did_you_mean
from estbench.report import contact
from estbench.report.figures import data, innovations, palette, traces
from estbench.report.figures.data import Steps, thin
from estbench.report.figures.paper import WIDTHS, check_format, write
from estbench.report.sources import Entry

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

T = TypeVar("T")
EVENT_MARKS = {"touch-down": "v", "lift-off": "^", "slip": "s", "limit": "x"}
"""Kind of an event of contact -> its mark on the time axis."""
_NEED_TRACES = ("error", "histogram")


@dataclass(frozen=True, eq=False)
class Paper:
    """The content and the width of a figure.

    Attributes:
        entries: in order.
        columns: 1 or 2.
        run: number of the run whose error is drawn; None takes the worst of the first entry.
        coordinates: names; empty for all.
    """

    entries: Sequence[Entry]
    columns: int = 1
    run: int | None = None
    coordinates: Sequence[str] = ()

    @property
    def chosen(self) -> list[int]:
        """Indices of the coordinates."""
        names = self.entries[0].source.names
        for name in self.coordinates:
            if name not in names:
                raise EstbenchError(f"no coordinate '{name}'{did_you_mean(name, names)}")
        return [
            i for i, name in enumerate(names) if not self.coordinates or name in self.coordinates
        ]

    def title(self, i: int) -> str:
        """Name and unit of a coordinate."""
        source = self.entries[0].source
        return f"{source.names[i]} ({source.units[i]})"


def plot(paper: Paper, what: str, path: Path) -> None:
    """Draw one kind of figure into a file; its suffix is the format.

    Args:
        paper: content and width.
        what: one of `KINDS`.
        path: the file.

    Raises:
        EstbenchError: the kind or format is unknown, or the figure needs traces and has none.
        StoreError: the file cannot be written.
    """
    check_format(path)
    if what not in KINDS:
        raise EstbenchError(f"--what '{what}' is not known{did_you_mean(what, KINDS)}")
    if what in _NEED_TRACES and not all(e.source.has_traces for e in paper.entries):
        raise StoreError(
            f"--what {what} needs traces, and this store kept none; run with --keep diagonal"
        )
    write(lambda: KINDS[what](paper), path)


def _figure(paper: Paper, rows: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(WIDTHS[paper.columns], height * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.ravel())


def _grid(paper: Paper, count: int, height: float = 1.25) -> tuple[Figure, list[Axes]]:
    """Small axes, one per coordinate."""
    columns = min(count, 1 if paper.columns == 1 else 3 if count > 4 else 2)
    rows = -(-count // columns)
    figure, axes = _figure(paper, rows, columns, height if rows > 1 else 1.7)
    for extra in axes[count:]:
        extra.remove()
    for ax in axes[max(0, count - columns) : count]:
        ax.set_xlabel("time (s)")
    return figure, axes[:count]


def _style(index: int) -> dict[str, Any]:
    return {
        "color": palette.colour(index),
        "linestyle": palette.LINES[index % len(palette.LINES)],
    }


def _legend(
    figure: Figure, paper: Paper, ax: Axes, band: str = "", marks: Iterable[str] = ()
) -> None:
    """The legend above the figure: entries, the grey band, and kinds of events."""
    handles: list[Any] = [
        ax.plot([], [], **_style(k), label=e.key)[0] for k, e in enumerate(paper.entries)
    ]
    if band:
        handles.append(Patch(facecolor="#cccccc", lw=0, label=band))
    handles += [
        ax.plot([], [], ls="none", color="#333333", ms=4, marker=EVENT_MARKS[kind], label=kind)[0]
        for kind in marks
    ]
    columns = min(len(handles), 3 if paper.columns == 1 else 6)
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)


def _over_time(paper: Paper, label: str, steps: Callable[[Entry], Steps]) -> Figure:
    figure, (ax,) = _figure(paper, 1, 1, 1.9)
    curves = [steps(entry) for entry in paper.entries]
    drawn: set[bytes] = set()
    for k, curve in enumerate(curves):
        keep = thin(np.stack([curve.mean, curve.low], axis=1), data.POINTS)
        low, high = curve.low[keep], curve.high[keep]
        if low.tobytes() + high.tobytes() not in drawn:
            drawn.add(low.tobytes() + high.tobytes())
            ax.fill_between(curve.time[keep], low, high, color="#cccccc", lw=0)
        ax.plot(curve.time[keep], curve.mean[keep], **_style(k))
    _log(ax, [c.mean for c in curves])
    ax.set(xlabel="time (s)", ylabel=f"mean {label}")
    ax.margins(x=0.01)
    _legend(figure, paper, ax, f"{paper.entries[0].source.level:.0%} band")
    return figure


def _log(ax: Axes, curves: Sequence[Any]) -> None:
    values = np.concatenate([c[np.isfinite(c) & (c > 0)] for c in curves])
    if len(values) and values.max() > 8 * np.percentile(values, 5):
        ax.set_yscale("log")


def _nees(paper: Paper) -> Figure:
    return _over_time(paper, "NEES/n", data.nees_steps)


def _nis(paper: Paper) -> Figure:
    return _over_time(paper, "NIS/m", data.nis_steps)


def _rmse(paper: Paper) -> Figure:
    chosen = paper.chosen
    figure, axes = _grid(paper, len(chosen))
    curves = []
    for entry in paper.entries:
        statistics = traces.statistics(entry)
        curves.append(data.rmse_steps(entry, statistics.fourth if statistics else None))
    for ax, i in zip(axes, chosen):
        for k, curve in enumerate(curves):
            keep = thin(curve.rmse[:, i], data.POINTS)
            time = curve.time[keep]
            ax.fill_between(
                time, curve.low[keep, i], curve.high[keep, i], color=palette.colour(k), alpha=0.2,
                lw=0,
            )  # fmt: skip
            ax.plot(time, curve.rmse[keep, i], **_style(k))
            ax.plot(time, curve.sigma[keep, i], color=palette.colour(k), ls=(0, (1, 1)), lw=0.9)
        _log(ax, [c.rmse[:, i] for c in curves])
        ax.set_ylabel(paper.title(i))
        ax.margins(x=0.01)
    _legend(figure, paper, axes[0])
    return figure


def _error(paper: Paper) -> Figure:
    chosen = paper.chosen
    entry = paper.entries[0]
    anees = np.where(np.isfinite(entry.record["anees"]), entry.record["anees"], np.inf)
    run = paper.run if paper.run is not None else int(entry.source.runs[anees.argmax()])
    found = [traces.run_trace(e, run, data.POINTS) for e in paper.entries]
    if not any(found):
        raise entry.no_run(run)
    figure, axes = _grid(paper, len(chosen))
    marks = contact.events(entry, run) if found[0] is not None else {}
    for ax, i in zip(axes, chosen):
        settled = 0.0
        for k, trace in enumerate(found):
            if trace is None:
                continue
            time, error, std = trace.time, trace.error[i], trace.std[i]
            for sigmas, alpha in ((3, 0.13), (1, 0.2)):
                ax.fill_between(
                    time, -sigmas * std, sigmas * std, color=palette.colour(k), alpha=alpha, lw=0
                )
            ax.plot(time, error, **_style(k))
            late = time > time[0] + 0.06 * (time[-1] - time[0])
            with np.errstate(invalid="ignore"):
                settled = max(settled, float(np.nanmax(np.abs([3 * std[late], error[late]]))))
        ax.set_ylim(-1.08 * settled, 1.08 * settled)
        ax.set_ylabel(paper.title(i))
        ax.margins(x=0.01)
        for kind, times in marks.items():
            ax.plot(times, [0.0] * len(times), transform=ax.get_xaxis_transform(), ls="none",
                    color="#333333", ms=4, marker=EVENT_MARKS[kind], clip_on=False)  # fmt: skip
    _legend(figure, paper, axes[0], marks=marks)
    figure.supxlabel(f"error of run {run} with ±1σ and ±3σ", fontsize=7, color="#555555")
    return figure


def _statistics(paper: Paper) -> list[traces.TraceStatistics]:
    return [s for s in map(traces.statistics, paper.entries) if s is not None]


def _coverage(paper: Paper) -> Figure:
    chosen, found = paper.chosen, _known(paper, "coverage", data.coverage)
    names = paper.entries[0].source.names
    stacked = paper.columns == 1
    rows = len(SIGMAS) if stacked else 1
    height = 0.55 + 0.17 * len(chosen)
    figure, axes = _figure(paper, rows, len(SIGMAS) // rows, height)
    place = np.arange(len(chosen))
    for s, (ax, sigmas, expected) in enumerate(zip(axes, SIGMAS, EXPECTED)):
        ax.axvline(expected, color="#777777", ls="--", lw=0.9)
        for k, coverage in enumerate(found):
            cells = [coverage[i].shares[s] for i in chosen]
            value = np.array([c.value for c in cells])
            spread = [value - [c.low for c in cells], [c.high for c in cells] - value]
            offset = 0.5 * ((k + 1) / (len(found) + 1) - 0.5)
            ax.errorbar(
                value, place + offset, xerr=spread, fmt="o", ms=2.5, lw=0.9, capsize=1.5,
                color=palette.colour(k),
            )  # fmt: skip
        ax.locator_params(axis="x", nbins=5)
        ax.set_yticks(place, [names[i] for i in chosen] if stacked or s == 0 else [])
        ax.set_ylim(len(chosen) - 0.5, -0.5)
        ax.set_xlabel(f"share within {sigmas}σ ({expected:.4f} expected)")
    _legend(figure, paper, axes[0])
    return figure


def _histogram(paper: Paper) -> Figure:
    chosen, found = paper.chosen, _statistics(paper)
    figure, axes = _grid(paper, len(chosen), 1.15)
    x = np.linspace(-5, 5, 201)
    for ax, i in zip(axes, chosen):
        ax.fill_between(x, stats.norm.pdf(x), color="#cccccc", lw=0)
        for k, statistics in enumerate(found):
            ax.stairs(statistics.errors[i], traces.ERROR_EDGES, **_style(k), lw=0.9)
        ax.set_ylabel(paper.entries[0].source.names[i])
        ax.set_xlabel("error / σ" if ax.get_xlabel() else "")
    _legend(figure, paper, axes[0])
    return figure


def _autocorrelation(paper: Paper) -> Figure:
    """Autocorrelation of NIS, or of the whitened innovations for stores without traces."""
    figure, (ax,) = _figure(paper, 1, 1, 1.9)
    if all(e.source.has_traces for e in paper.entries):
        curves = [_of_nis(statistics) for statistics in _statistics(paper)]
        ax.set(xlabel="lag (instants)", ylabel="autocorrelation of NIS")
    else:
        found = _known(paper, "autocorrelation", innovations.whole)
        curves = [
            (1 + np.arange(len(c.band)), np.array([i.value for i in c.found.correlation]), c.band)
            for c in found
        ]
        ax.set(xlabel="lag (readings of a channel)", ylabel="autocorrelation, innovations")
    for k, (lags, values, half) in enumerate(curves):
        if k == 0:
            ax.fill_between(lags, -half, half, color="#cccccc", lw=0)
        ax.plot(lags, values, marker=".", ms=3, **_style(k))
    _legend(figure, paper, ax, f"{paper.entries[0].source.level:.0%} band")
    return figure


def _of_nis(statistics: traces.TraceStatistics) -> tuple[Any, Any, Any]:
    """Lags, correlation, half-width of its band."""
    lags = np.flatnonzero(np.isfinite(statistics.correlation))[1:]
    return lags, statistics.correlation[lags], statistics.correlation_band[lags]


def _known(paper: Paper, what: str, of: Callable[[Entry], T | None]) -> list[T]:
    """A statistic of each entry; an error if one entry does not have it."""
    found = [of(entry) for entry in paper.entries]
    for entry, one in zip(paper.entries, found):
        if one is None:
            raise StoreError(
                f"{entry.source.folder} has no {what} of {entry.label}: it is of an older version, "
                "or too short; run it again"
            )
    return [one for one in found if one is not None]


KINDS: dict[str, Callable[[Paper], Figure]] = {
    "nees": _nees,
    "nis": _nis,
    "error": _error,
    "rmse": _rmse,
    "coverage": _coverage,
    "histogram": _histogram,
    "autocorrelation": _autocorrelation,
}
