"""`estbench plot`: the report's figures for papers, with matplotlib, one or two columns wide."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy import stats

from estbench.consistency.coverage import EXPECTED, SIGMAS
from estbench.errors import EstbenchError, MissingExtraError, StoreError, did_you_mean
from estbench.report import contact
from estbench.report.figures import around, data, innovations, palette, residuals, traces
from estbench.report.figures.data import Steps, thin
from estbench.report.figures.frame import Paper, event_mark, figure_of, grid, legend, style
from estbench.report.figures.paper import check_format, write
from estbench.report.sources import Entry

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

T = TypeVar("T")
_NEED_TRACES = ("error", "histogram", "touch-down")
_NEED_TRUTH = ("nees", "error", "rmse", "coverage", "histogram", "touch-down")


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
    bare = [e.source.folder for e in paper.entries if not e.source.has_truth]
    if what in _NEED_TRUTH and bare:
        raise StoreError(
            f"--what {what} needs the truth, and {bare[0]} is a replay without it; use nis, "
            "innovation or autocorrelation"
        )
    write(lambda: KINDS[what](paper), path)


def _over_time(paper: Paper, label: str, steps: Callable[[Entry], Steps]) -> Figure:
    figure, (ax,) = figure_of(paper, 1, 1, 1.9)
    curves = [steps(entry) for entry in paper.entries]
    drawn: set[bytes] = set()
    for k, curve in enumerate(curves):
        keep = thin(np.stack([curve.mean, curve.low], axis=1), data.POINTS)
        low, high = curve.low[keep], curve.high[keep]
        if low.tobytes() + high.tobytes() not in drawn:
            drawn.add(low.tobytes() + high.tobytes())
            ax.fill_between(curve.time[keep], low, high, color="#cccccc", lw=0)
        ax.plot(curve.time[keep], curve.mean[keep], **style(k))
    _log(ax, [c.mean for c in curves])
    ax.set(xlabel="time (s)", ylabel=f"mean {label}")
    ax.margins(x=0.01)
    legend(figure, paper, ax, f"{paper.entries[0].source.level:.0%} band")
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
    figure, axes = grid(paper, len(chosen))
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
            ax.plot(time, curve.rmse[keep, i], **style(k))
            ax.plot(time, curve.sigma[keep, i], color=palette.colour(k), ls=(0, (1, 1)), lw=0.9)
        _log(ax, [c.rmse[:, i] for c in curves])
        ax.set_ylabel(paper.title(i))
        ax.margins(x=0.01)
    legend(figure, paper, axes[0])
    return figure


def _error(paper: Paper) -> Figure:
    chosen = paper.chosen
    entry = paper.entries[0]
    anees = np.where(np.isfinite(entry.record["anees"]), entry.record["anees"], np.inf)
    run = paper.run if paper.run is not None else int(entry.source.runs[anees.argmax()])
    found = [traces.run_trace(e, run, data.POINTS) for e in paper.entries]
    if not any(found):
        raise entry.no_run(run)
    figure, axes = grid(paper, len(chosen))
    marks = contact.events(entry, [run])[0] if found[0] is not None else {}
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
            ax.plot(time, error, **style(k))
            late = time > time[0] + 0.06 * (time[-1] - time[0])
            with np.errstate(invalid="ignore"):
                settled = max(settled, float(np.nanmax(np.abs([3 * std[late], error[late]]))))
        ax.set_ylim(-1.08 * settled, 1.08 * settled)
        ax.set_ylabel(paper.title(i))
        ax.margins(x=0.01)
        for kind, times in marks.items():
            zeros, above = [0.0] * len(times), ax.get_xaxis_transform()
            ax.plot(times, zeros, **event_mark(kind), transform=above, clip_on=False)
    legend(figure, paper, axes[0], marks=marks)
    figure.supxlabel(f"error of run {run} with ±1σ and ±3σ", fontsize=7, color="#555555")
    return figure


def _touch_down(paper: Paper) -> Figure:
    """NEES/n around the touch-downs, with its interval across runs."""
    figure, (ax,) = figure_of(paper, 1, 1, 1.9)
    curves = [around.nees(entry, "touch-down") for entry in paper.entries]
    ax.axhline(1.0, color="#777777", ls="--", lw=0.9)
    ax.axvline(0.0, color="#777777", lw=0.6)
    for k, curve in enumerate(curves):
        ax.fill_between(curve.lag, curve.low, curve.high, color=palette.colour(k), alpha=0.2, lw=0)
        ax.plot(curve.lag, curve.mean, marker=".", ms=3, **style(k))
    _log(ax, [c.mean for c in curves])
    ax.set(xlabel="instants after a touch-down", ylabel="mean NEES/n")
    legend(figure, paper, ax)
    return figure


def _innovation(paper: Paper) -> Figure:
    """Innovations of one run with ±1σ and ±3σ, one panel for each component."""
    run = paper.run or 0
    for entry in paper.entries:
        if entry.position(run) is None:
            raise entry.no_run(run)
    found = [{r.name: r for r in residuals.residuals(e, run)} for e in paper.entries]
    names = list(dict.fromkeys(name for components in found for name in components))
    if not names:
        raise StoreError(
            f"--what innovation needs innovations, and {paper.entries[0].source.folder} kept none; "
            "run with --keep full"
        )
    figure, panels = grid(paper, len(names))
    for ax, name in zip(panels, names):
        for k, components in enumerate(found):
            if (r := components.get(name)) is None:
                continue
            for sigmas, alpha in ((3, 0.13), (1, 0.2)):
                ax.fill_between(
                    r.time, -sigmas * r.std, sigmas * r.std, color=palette.colour(k), alpha=alpha,
                    lw=0,
                )  # fmt: skip
            ax.plot(r.time, r.value, **style(k), lw=0.7)
            ax.set_ylabel(f"{name} ({r.unit})" if r.unit else name)
        ax.margins(x=0.01)
    legend(figure, paper, panels[0])
    figure.supxlabel(f"innovation of run {run} with ±1σ and ±3σ", fontsize=7, color="#555555")
    return figure


def _statistics(paper: Paper) -> list[traces.TraceStatistics]:
    return [s for s in map(traces.statistics, paper.entries) if s is not None]


def _coverage(paper: Paper) -> Figure:
    chosen, found = paper.chosen, _known(paper, "coverage", data.coverage)
    names = paper.entries[0].source.names
    stacked = paper.columns == 1
    rows = len(SIGMAS) if stacked else 1
    height = 0.55 + 0.17 * len(chosen)
    figure, axes = figure_of(paper, rows, len(SIGMAS) // rows, height)
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
    legend(figure, paper, axes[0])
    return figure


def _histogram(paper: Paper) -> Figure:
    chosen, found = paper.chosen, _statistics(paper)
    figure, axes = grid(paper, len(chosen), 1.15)
    x = np.linspace(-5, 5, 201)
    for ax, i in zip(axes, chosen):
        ax.fill_between(x, stats.norm.pdf(x), color="#cccccc", lw=0)
        for k, statistics in enumerate(found):
            ax.stairs(statistics.errors[i], traces.ERROR_EDGES, **style(k), lw=0.9)
        ax.set_ylabel(paper.entries[0].source.names[i])
        ax.set_xlabel("error / σ" if ax.get_xlabel() else "")
    legend(figure, paper, axes[0])
    return figure


def _autocorrelation(paper: Paper) -> Figure:
    """Autocorrelation of NIS, or of the whitened innovations for stores without traces."""
    figure, (ax,) = figure_of(paper, 1, 1, 1.9)
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
        ax.plot(lags, values, marker=".", ms=3, **style(k))
    legend(figure, paper, ax, f"{paper.entries[0].source.level:.0%} band")
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
    "touch-down": _touch_down,
    "innovation": _innovation,
}
