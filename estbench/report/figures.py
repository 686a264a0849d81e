"""The page's figures in plotly. Each trace's `meta` says whose it is, so that the page can choose.

`meta` holds `entry` (drawn while that entry is chosen; always without it), `band` (drawn once for
all entries with the same band), and `bind`: the row of the chosen run's data that is its y.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from estbench.errors import MissingExtraError
from estbench.report import data, palette
from estbench.report.data import Rmse, Steps, thin
from estbench.report.sources import Entry
from estbench.report.traces import ERROR_EDGES, SIGMAS, TraceStatistics

try:
    import plotly.graph_objects as go
except ImportError:
    raise MissingExtraError("plotly", "report") from None

Array = NDArray[np.float64]
BAND = palette.rgba(palette.GREY, 0.22)


@dataclass(frozen=True, eq=False)
class Drawing:
    """One figure of the page.

    Attributes:
        name: its id on the page.
        title: what it shows.
        traces: plotly traces as plain data.
        layout: plotly layout as plain data.
        height: pixels.
        time: whether the x axis is time, shared with the others.
        coordinate: index of the coordinate it is about, or None.
        trim: whether the first instants may be cut off at the top and bottom.
    """

    name: str
    title: str
    traces: list[dict[str, Any]]
    layout: dict[str, Any]
    height: int
    time: bool = False
    coordinate: int | None = None
    trim: bool = False


@dataclass(frozen=True, eq=False)
class Material:
    """What is drawn: entries, and their statistics in the same order."""

    entries: Sequence[Entry]
    traces: Sequence[TraceStatistics | None]
    nees: list[Steps] = field(default_factory=list)
    nis: list[Steps] = field(default_factory=list)
    rmse: list[Rmse] = field(default_factory=list)

    def __post_init__(self) -> None:
        for entry, traces in zip(self.entries, self.traces):
            self.nees.append(data.nees_steps(entry))
            self.nis.append(data.nis_steps(entry))
            self.rmse.append(data.rmse_steps(entry, traces.fourth if traces else None))

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates, the same for all entries."""
        return self.entries[0].source.names

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return self.entries[0].source.units


def drawings(material: Material) -> dict[str, list[Drawing]]:
    """All figures by section of the page; those that need traces only where there are any."""
    n = range(len(material.names))
    out = {
        "verdict": [_verdict(material)],
        "consistency": [_steps(material, "nees"), _steps(material, "nis")],
        "rmse": [_rmse(material, i) for i in n],
        "cost": [_cost(material)],
        "error": [],
        "coverage": [],
        "density": [],
        "correlation": [],
    }
    if any(material.traces):
        out["error"] = [_run_nees(material), *(_error(material, i) for i in n)]
        out["coverage"] = [_coverage(material, k) for k in range(len(SIGMAS))]
        out["density"] = [_nees_density(material), *(_error_density(material, i) for i in n)]
        out["correlation"] = [_correlation(material)]
    return out


def _line(index: int, x: Any, y: Any, name: str, **more: Any) -> go.Scatter:
    line = {"color": palette.colour(index), "width": 1.6, "dash": palette.dash(index)}
    return go.Scatter(
        x=x, y=y, mode="lines", name=name, line=line | more.pop("line", {}), showlegend=False,
        **more,
    )  # fmt: skip


def _area(x: Any, low: Any, high: Any, fill: str, meta: dict[str, Any]) -> list[go.Scatter]:
    """Two lines without width and the area between them."""
    common: dict[str, Any] = {
        "x": x, "mode": "lines", "line": {"width": 0, "color": fill}, "hoverinfo": "skip",
        "showlegend": False, "connectgaps": False,
    }  # fmt: skip
    return [
        go.Scatter(y=low, meta=meta | {"side": "low"}, **common),
        go.Scatter(y=high, fill="tonexty", fillcolor=fill, meta=meta | {"side": "high"}, **common),
    ]


def _drawing(
    name: str, title: str, traces: Sequence[Any], layout: dict[str, Any], height: int, **more: Any
) -> Drawing:
    plain = go.Figure(data=list(traces), layout=layout).to_dict()
    plain["layout"].pop("template", None)
    return Drawing(name, title, plain["data"], plain["layout"], height, **more)


def _axes(x: str, y: str, **more: Any) -> dict[str, Any]:
    title = {"x": {"text": x, "standoff": 4}, "y": {"text": y, "standoff": 4}}
    return {"xaxis": {"title": title["x"]}, "yaxis": {"title": title["y"]} | more}


def _span(curves: Sequence[Array]) -> dict[str, Any]:
    """A logarithmic y axis where the curves span more than a factor of 8."""
    values = np.concatenate([c[np.isfinite(c) & (c > 0)] for c in curves])
    wide = len(values) and values.max() > 8 * np.percentile(values, 5)
    return {"type": "log"} if wide else {}


def _steps(material: Material, what: str) -> Drawing:
    curves = material.nees if what == "nees" else material.nis
    label = "NEES/n" if what == "nees" else "NIS/m"
    traces: list[Any] = []
    for i, (entry, steps) in enumerate(zip(material.entries, curves)):
        keep = thin(np.stack([steps.mean, steps.low], axis=1), data.POINTS)
        x, low, high = steps.time[keep], steps.low[keep], steps.high[keep]
        same = hashlib.sha1(x.tobytes() + low.tobytes() + high.tobytes()).hexdigest()[:12]
        traces += _area(x, low, high, BAND, {"entry": entry.key, "band": same})
        traces.append(
            _line(i, x, steps.mean[keep], entry.key, meta={"entry": entry.key, "role": "mean"})
        )
    level = material.entries[0].source.level
    layout = _axes("time (s)", f"mean {label}", **_span([s.mean for s in curves]))
    return _drawing(
        what, f"{label} averaged over the runs, with the {level:.0%} band", traces, layout, 300,
        time=True,
    )  # fmt: skip


def _rmse(material: Material, i: int) -> Drawing:
    traces: list[Any] = []
    for k, (entry, curve) in enumerate(zip(material.entries, material.rmse)):
        keep = thin(curve.rmse[:, i], data.POINTS // 2)
        x, meta = curve.time[keep], {"entry": entry.key}
        low, high = curve.low[keep, i], curve.high[keep, i]
        traces += _area(x, low, high, palette.faint(k, 0.2), meta)
        traces += [
            _line(k, x, curve.rmse[keep, i], f"{entry.key} RMSE", meta=meta | {"role": "rmse"}),
            _line(
                k, x, curve.sigma[keep, i], f"{entry.key} σ", meta=meta | {"role": "sigma"},
                line={"dash": "dot", "width": 1.4},
            ),
        ]  # fmt: skip
    name, unit = material.names[i], material.units[i]
    layout = _axes("time (s)", unit, **_span([c.rmse[:, i] for c in material.rmse]))
    return _drawing(f"rmse-{i}", name, traces, layout, 230, time=True, coordinate=i)


def _error(material: Material, i: int) -> Drawing:
    """Error of the chosen run; the page fills x and y in."""
    traces: list[Any] = []
    for k, entry in enumerate(material.entries):
        for sigmas, alpha in ((3, 0.12), (1, 0.2)):
            low, high = _area([], [], [], palette.faint(k, alpha), {"entry": entry.key})
            low.meta |= {"bind": {"field": "std", "row": i, "scale": -sigmas}}
            high.meta |= {"bind": {"field": "std", "row": i, "scale": sigmas}}
            traces += [low, high]
        bind = {"field": "error", "row": i, "scale": 1}
        meta = {"entry": entry.key, "bind": bind, "role": "error"}
        traces.append(_line(k, [], [], entry.key, meta=meta, line={"width": 1.3}))
    layout = _axes("time (s)", material.units[i], zeroline=True)
    return _drawing(
        f"error-{i}", material.names[i], traces, layout, 230, time=True, coordinate=i, trim=True
    )


def _run_nees(material: Material) -> Drawing:
    source = material.entries[0].source
    low, high = data.chi_square_band(source.n, 1, source.level)
    ends = [float(source.times[0]), max(float(e.source.times[-1]) for e in material.entries)]
    traces: list[Any] = _area(
        ends, [low / source.n] * 2, [high / source.n] * 2, BAND, {"band": "run"}
    )
    for k, entry in enumerate(material.entries):
        bind = {"field": "nees", "row": 0, "scale": 1}
        meta = {"entry": entry.key, "bind": bind, "role": "nees"}
        traces.append(_line(k, [], [], entry.key, meta=meta, line={"width": 1.3}))
    layout = _axes("time (s)", "NEES/n of the run")
    title = f"NEES/n of the run, with the {source.level:.0%} band of a single run"
    return _drawing("run-nees", title, traces, layout, 230, time=True)


def _verdict(material: Material) -> Drawing:
    """NEES/n of each entry with its interval, against 1 ± tolerance."""
    tolerance = material.entries[0].source.scenario.consistency.tolerance
    traces = []
    for k, entry in enumerate(material.entries):
        i = entry.summary.anees
        spread = {"array": [i.high - i.value], "arrayminus": [i.value - i.low], "type": "data"}
        finite = np.isfinite([i.low, i.high]).all()
        traces.append(
            go.Scatter(
                x=[i.value], y=[entry.key], mode="markers", name=entry.key, showlegend=False,
                marker={"color": palette.colour(k), "size": 10},
                error_x=spread | {"thickness": 2, "width": 6} if finite else None,
                meta={"entry": entry.key, "role": "anees"},
            )
        )  # fmt: skip
    values = [e.summary.anees.value for e in material.entries]
    wide = max(values, default=1) > 5 or min(values, default=1) < 0.2
    layout = _axes("NEES/n", "") | {
        "shapes": [
            {"type": "rect", "xref": "x", "yref": "paper", "x0": 1 - tolerance,
             "x1": 1 + tolerance, "y0": 0, "y1": 1, "fillcolor": BAND, "line": {"width": 0},
             "layer": "below"},
        ],
    }  # fmt: skip
    layout["xaxis"] |= {"type": "log"} if wide else {}
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    title = f"NEES/n with its interval across runs; 1 ± {tolerance:g} is consistent"
    return _drawing("verdict", title, traces, layout, 90 + 30 * len(values))


def _coverage(material: Material, k: int) -> Drawing:
    """Share of errors within so many σ, a dot a coordinate."""
    names = material.names
    expected = float(stats.chi2.cdf(SIGMAS[k] ** 2, 1))
    drawn = [(j, e, t) for j, (e, t) in enumerate(zip(material.entries, material.traces)) if t]
    traces = []
    for place, (j, entry, statistics) in enumerate(drawn):
        cells = statistics.coverage[k]
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
    layout = _axes("share of the errors", "") | {
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
    return _drawing(f"coverage-{SIGMAS[k]}", title, traces, layout, 90 + 24 * len(names))


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
        traces.append(_line(k, centres, y, entry.key, meta=meta, line={"shape": "hvh"}))
    return _drawing(
        name, title, traces, _axes(label, "density", rangemode="tozero"), 220,
        coordinate=coordinate,
    )  # fmt: skip


def _drawn(material: Material) -> list[tuple[int, Entry, TraceStatistics]]:
    pairs = zip(material.entries, material.traces)
    return [(k, entry, traces) for k, (entry, traces) in enumerate(pairs) if traces is not None]


def _nees_density(material: Material) -> Drawing:
    drawn = _drawn(material)
    edges, n = drawn[0][2].nees_edges, len(material.names)
    centres = 0.5 * (edges[1:] + edges[:-1])
    curves = [(k, entry, traces.nees) for k, entry, traces in drawn]
    title = f"NEES against the chi-square density with {n} degrees of freedom"
    return _density("density-nees", title, "NEES", curves, edges, stats.chi2.pdf(centres, n), None)


def _error_density(material: Material, i: int) -> Drawing:
    centres = 0.5 * (ERROR_EDGES[1:] + ERROR_EDGES[:-1])
    curves = [(k, entry, traces.errors[i]) for k, entry, traces in _drawn(material)]
    return _density(
        f"density-{i}", material.names[i], "error / σ", curves, ERROR_EDGES,
        stats.norm.pdf(centres), i,
    )  # fmt: skip


def _correlation(material: Material) -> Drawing:
    traces: list[Any] = []
    for k, entry, statistics in _drawn(material):
        lags = np.flatnonzero(np.isfinite(statistics.correlation))[1:]
        half = statistics.correlation_band[lags]
        same = hashlib.sha1(half.tobytes()).hexdigest()[:12]
        traces += _area(lags, -half, half, BAND, {"entry": entry.key, "band": same})
        traces.append(
            _line(
                k, lags, statistics.correlation[lags], entry.key,
                meta={"entry": entry.key, "role": "correlation"},
            ).update(mode="lines+markers", marker={"size": 4, "color": palette.colour(k)})
        )  # fmt: skip
    level = material.entries[0].source.level
    title = f"Autocorrelation of NIS, with the {level:.0%} band of independent innovations"
    layout = _axes("lag (instants)", "correlation", zeroline=True)
    return _drawing("correlation", title, traces, layout, 280)


def _cost(material: Material) -> Drawing:
    traces = [
        go.Bar(
            x=[entry.summary.cost], y=[entry.key], orientation="h", name=entry.key,
            marker={"color": palette.colour(k)}, text=[f"{entry.summary.cost:.3g}"],
            showlegend=False, meta={"entry": entry.key, "role": "cost"},
        )
        for k, entry in enumerate(material.entries)
    ]  # fmt: skip
    layout = _axes("µs of one core for each run and step", "")
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    return _drawing(
        "cost", "Cost per step", traces, layout, 90 + 30 * len(material.entries)
    )
