"""The page's other figures: verdicts, coverage, densities, correlation, cost."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from estbench.consistency.coverage import EXPECTED, SIGMAS
from estbench.errors import MissingExtraError
from estbench.report.figures import palette
from estbench.report.figures.drawing import BAND, Drawing, Material, area, axes, drawing, line
from estbench.report.figures.innovations import Correlation
from estbench.report.figures.traces import ERROR_EDGES, TraceStatistics
from estbench.report.sources import Entry
from estbench.shapes import Array
from estbench.tables.quantity import number

try:
    import plotly.graph_objects as go
except ImportError:
    raise MissingExtraError("plotly", "report") from None


def verdict(material: Material) -> Drawing:
    """NEES/n of each entry with its interval, against 1 ± tolerance; NIS/m without truth."""
    what = "NEES/n" if material.truth else "NIS/m"
    tolerance = material.entries[0].source.scenario.consistency.tolerance
    traces, found = [], list[float]()
    for k, entry in enumerate(material.entries):
        i = entry.summary.anees if material.truth else entry.summary.anis
        found.append(i.value)
        spread = {"array": [i.high - i.value], "arrayminus": [i.value - i.low], "type": "data"}
        finite = np.isfinite([i.low, i.high]).all()
        traces.append(
            go.Scatter(
                x=[i.value], y=[entry.key], mode="markers", name=entry.key, showlegend=False,
                marker={"color": palette.colour(k), "size": 10},
                error_x=spread | {"thickness": 2, "width": 6} if finite else None,
                meta={"entry": entry.key, "role": "anees", "always": True},
            )
        )  # fmt: skip
    wide = max(found, default=1) > 5 or min(found, default=1) < 0.2
    layout: dict[str, Any] = axes(what, "") | {
        "shapes": [
            {"type": "rect", "xref": "x", "yref": "paper", "x0": 1 - tolerance,
             "x1": 1 + tolerance, "y0": 0, "y1": 1, "fillcolor": BAND, "line": {"width": 0},
             "layer": "below"},
        ],
    }  # fmt: skip
    layout["xaxis"] |= {"type": "log"} if wide else {}
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    across = "runs" if material.entries[0].source.log is None else "the parts of the log"
    title = f"{what} with its interval across {across}; 1 ± {tolerance:g} is consistent"
    return drawing("verdict", title, traces, layout, 90 + 30 * len(found))


def coverage(material: Material, k: int) -> Drawing:
    """Share of errors within kσ, one dot per coordinate."""
    names = material.names
    expected = EXPECTED[k]
    drawn = [(j, e, c) for j, (e, c) in enumerate(zip(material.entries, material.coverage)) if c]
    traces = []
    for place, (j, entry, found) in enumerate(drawn):
        cells = [coordinate.shares[k] for coordinate in found]
        offset = 0.5 * ((place + 1) / (len(drawn) + 1) - 0.5)
        traces.append(
            go.Scatter(
                x=[c.value for c in cells], y=[i + offset for i in range(len(names))],
                error_x={"type": "data", "array": [c.high - c.value for c in cells],
                         "arrayminus": [c.value - c.low for c in cells], "thickness": 1.5,
                         "width": 3},
                mode="markers", marker={"color": palette.colour(j), "size": 7}, name=entry.key,
                text=list(names), hovertemplate="%{text}: %{x:.4f}<extra>" + entry.key + "</extra>",
                showlegend=False, meta={"entry": entry.key, "role": f"coverage-{SIGMAS[k]}"},
            )
        )  # fmt: skip
    layout: dict[str, Any] = axes("share of the errors", "") | {
        "shapes": [
            {"type": "line", "xref": "x", "yref": "paper", "x0": expected, "x1": expected,
             "y0": 0, "y1": 1, "line": {"color": palette.GREY, "dash": "dash", "width": 1.5}},
        ],
    }  # fmt: skip
    layout["yaxis"] |= {
        "tickvals": list(range(len(names))), "ticktext": list(names), "automargin": True,
        "range": [len(names) - 0.5, -0.5], "zeroline": False,
    }  # fmt: skip
    title = f"within {SIGMAS[k]}σ ({expected:.4f} expected)"
    return drawing(f"coverage-{SIGMAS[k]}", title, traces, layout, 90 + 24 * len(names))


def _density(
    name: str, title: str, label: str, curves: list[tuple[int, Entry, Array]], edges: Array,
    density: Array, coordinate: int | None,
) -> Drawing:  # fmt: skip
    centres = 0.5 * (edges[1:] + edges[:-1])
    traces: list[Any] = [
        go.Scatter(
            x=centres, y=density, mode="lines", name="expected", showlegend=False, fill="tozeroy",
            fillcolor=BAND, line={"color": palette.GREY, "width": 1}, hoverinfo="skip",
            meta={"role": "expected"},
        )
    ]  # fmt: skip
    for k, entry, y in curves:
        meta = {"entry": entry.key, "role": "density"}
        traces.append(line(k, centres, y, entry.key, meta=meta, line={"shape": "hvh"}))
    return drawing(
        name, title, traces, axes(label, "density", rangemode="tozero"), 220,
        coordinate=coordinate,
    )  # fmt: skip


def _drawn(material: Material) -> list[tuple[int, Entry, TraceStatistics]]:
    pairs = zip(material.entries, material.traces)
    return [(k, entry, traces) for k, (entry, traces) in enumerate(pairs) if traces is not None]


def nees_density(material: Material) -> Drawing:
    """NEES against the chi-square density."""
    drawn = _drawn(material)
    edges, n = drawn[0][2].nees_edges, len(material.names)
    centres = 0.5 * (edges[1:] + edges[:-1])
    curves = [(k, entry, traces.nees) for k, entry, traces in drawn]
    ranks = drawn[0][2].ranks
    degrees = f"{n} degrees of freedom" if ranks[n] == 1 else "the ranks of P as its degrees"
    title = f"NEES against the chi-square density with {degrees}"
    expected = sum(share * stats.chi2.pdf(centres, r) for r, share in enumerate(ranks) if r)
    return _density("density-nees", title, "NEES", curves, edges, np.asarray(expected), None)


def error_density(material: Material, i: int) -> Drawing:
    """Error/σ of a coordinate against the normal density."""
    centres = 0.5 * (ERROR_EDGES[1:] + ERROR_EDGES[:-1])
    curves = [(k, entry, traces.errors[i]) for k, entry, traces in _drawn(material)]
    return _density(
        f"density-{i}", material.names[i], "error / σ", curves, ERROR_EDGES,
        stats.norm.pdf(centres), i,
    )  # fmt: skip


def correlation(material: Material) -> Drawing:
    """Autocorrelation of NIS with its band."""
    traces: list[Any] = []
    for k, entry, statistics in _drawn(material):
        lags = np.flatnonzero(np.isfinite(statistics.correlation))[1:]
        half = statistics.correlation_band[lags]
        same = hashlib.sha1(half.tobytes()).hexdigest()[:12]
        traces += area(lags, -half, half, BAND, {"entry": entry.key, "band": same})
        traces.append(
            line(
                k, lags, statistics.correlation[lags], entry.key,
                meta={"entry": entry.key, "role": "correlation"},
            ).update(mode="lines+markers", marker={"size": 4, "color": palette.colour(k)})
        )  # fmt: skip
    level = material.entries[0].source.level
    title = f"Autocorrelation of NIS, with the {level:.0%} band of independent innovations"
    layout = axes("lag (instants)", "correlation", zeroline=True)
    return drawing("nis-correlation", title, traces, layout, 280)


def innovations(material: Material) -> list[Drawing]:
    """Autocorrelation of the whitened innovations: of all together, then of each channel."""
    level = material.entries[0].source.level
    title = f"Autocorrelation of the whitened innovations, with the {level:.0%} band of white ones"
    out = [_innovations("innovations", title, material, material.white, 280)]
    names = dict.fromkeys(name for found in material.channels for name in found)
    out += [
        _innovations(
            f"innovations-{i}", name, material, [c.get(name) for c in material.channels], 220
        )
        for i, name in enumerate(names)
    ]
    return [d for d in out if d.traces]


def _innovations(
    name: str, title: str, material: Material, found: Sequence[Correlation | None], height: int
) -> Drawing:
    traces: list[Any] = []
    for k, (entry, one) in enumerate(zip(material.entries, found, strict=True)):
        if one is None:
            continue
        lags = np.arange(1, len(one.band) + 1)
        same = hashlib.sha1(one.band.tobytes()).hexdigest()[:12]
        traces += area(lags, -one.band, one.band, BAND, {"entry": entry.key, "band": same})
        traces.append(
            line(
                k, lags, [c.value for c in one.found.correlation], entry.key,
                meta={"entry": entry.key, "role": "innovations"},
            ).update(mode="lines+markers", marker={"size": 4, "color": palette.colour(k)})
        )  # fmt: skip
    layout = axes("lag (readings of a channel)", "correlation", zeroline=True)
    return drawing(name, title, traces, layout, height)


def cost(material: Material) -> Drawing:
    """Cost of each entry."""
    traces = [
        go.Bar(
            x=[entry.summary.cost], y=[entry.key], orientation="h", name=entry.key,
            marker={"color": palette.colour(k)}, text=[number(entry.summary.cost)],
            textposition="outside", cliponaxis=False,
            showlegend=False, meta={"entry": entry.key, "role": "cost", "always": True},
        )
        for k, entry in enumerate(material.entries)
    ]  # fmt: skip
    layout = axes("µs of one core for each run and step", "")
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    return drawing("step-cost", "Cost per step", traces, layout, 90 + 30 * len(material.entries))
