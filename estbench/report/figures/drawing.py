"""A figure of the page as plain data, and the parts that all figures share.

The `meta` of each trace tells the page when to draw it: `entry` (while that entry is selected;
always without it or with `always`), `band` (once for all entries with the same band), `bind` (the
row of the selected run's data that is its y), and `event` (the selected run's events of that kind
are its x).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estbench.consistency.coverage import Coverage
from estbench.errors import MissingExtraError
from estbench.report.figures import data, innovations, palette
from estbench.report.figures.data import Rmse, Steps
from estbench.report.figures.innovations import Correlation
from estbench.report.figures.traces import TraceStatistics
from estbench.report.sources import Entry
from estbench.shapes import Array

try:
    import plotly.graph_objects as go
except ImportError:
    raise MissingExtraError("plotly", "report") from None

BAND = palette.rgba(palette.GREY, 0.22)


@dataclass(frozen=True, eq=False)
class Drawing:
    """One figure of the page.

    Attributes:
        name: its id on the page.
        title: of the figure.
        traces: plotly traces as plain data.
        layout: plotly layout as plain data.
        height: pixels.
        time: whether the x axis is time, shared with other figures.
        coordinate: index of its coordinate, or None.
        trim: whether the y axis may cut off the first instants.
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
    """The entries to draw, and their statistics in the same order."""

    entries: Sequence[Entry]
    traces: Sequence[TraceStatistics | None]
    nees: list[Steps] = field(default_factory=list)
    nis: list[Steps] = field(default_factory=list)
    rmse: list[Rmse] = field(default_factory=list)
    coverage: list[tuple[Coverage, ...] | None] = field(default_factory=list)
    white: list[Correlation | None] = field(default_factory=list)
    channels: list[dict[str, Correlation]] = field(default_factory=list)

    def __post_init__(self) -> None:
        for entry, traces in zip(self.entries, self.traces):
            self.nees.append(data.nees_steps(entry))
            self.nis.append(data.nis_steps(entry))
            self.rmse.append(data.rmse_steps(entry, traces.fourth if traces else None))
            self.coverage.append(data.coverage(entry))
            self.white.append(innovations.whole(entry))
            self.channels.append(innovations.by_channel(entry))

    @property
    def truth(self) -> bool:
        """Whether the truth of any entry is known."""
        return any(entry.source.has_truth for entry in self.entries)

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates, the same for all entries."""
        return self.entries[0].source.names

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return self.entries[0].source.units


def line(index: int, x: Any, y: Any, name: str, **more: Any) -> go.Scatter:
    """A curve in the colour and dash of an entry."""
    look = {"color": palette.colour(index), "width": 1.6, "dash": palette.dash(index)}
    return go.Scatter(
        x=x, y=y, mode="lines", name=name, line=look | more.pop("line", {}), showlegend=False,
        **more,
    )  # fmt: skip


def area(x: Any, low: Any, high: Any, fill: str, meta: dict[str, Any]) -> list[go.Scatter]:
    """Two invisible lines and the area between them."""
    common: dict[str, Any] = {
        "x": x, "mode": "lines", "line": {"width": 0, "color": fill}, "hoverinfo": "skip",
        "showlegend": False, "connectgaps": False,
    }  # fmt: skip
    return [
        go.Scatter(y=low, meta=meta | {"side": "low"}, **common),
        go.Scatter(y=high, fill="tonexty", fillcolor=fill, meta=meta | {"side": "high"}, **common),
    ]


def event_marks(entries: Sequence[Entry]) -> list[go.Scatter]:
    """Marks of the selected run's events of contact on the time axis, one for each kind.

    They are those of the first selected entry, whose truth is that of all unless the controller
    sees the estimate. The page's script sets x and y.
    """
    return [
        go.Scatter(
            x=[], y=[], yaxis="y2", mode="markers", cliponaxis=False, showlegend=False,
            hovertemplate=f"{kind}<extra></extra>", meta={"entry": entry.key, "event": kind},
            marker={"symbol": symbol, "size": 7, "color": palette.GREY},
        )
        for entry in entries
        for kind, (_, symbol, _) in palette.EVENTS.items()
    ]  # fmt: skip


def drawing(
    name: str, title: str, traces: Sequence[Any], layout: dict[str, Any], height: int, **more: Any
) -> Drawing:
    """A figure of plotly as plain data, without the default template."""
    plain = go.Figure(data=list(traces), layout=layout).to_dict()
    plain["layout"].pop("template", None)
    return Drawing(name, title, plain["data"], plain["layout"], height, **more)


def axes(x: str, y: str, **more: Any) -> dict[str, dict[str, Any]]:
    """A layout with titles of the axes; `more` belongs to the y axis."""
    title = {"x": {"text": x, "standoff": 4}, "y": {"text": y, "standoff": 4}}
    return {"xaxis": {"title": title["x"]}, "yaxis": {"title": title["y"]} | more}


def with_marks(layout: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """A layout with the axis of `event_marks`, from the time axis at 0 to the top at 1."""
    marks = {"overlaying": "y", "range": [0, 1], "visible": False, "fixedrange": True}
    return layout | {"yaxis2": marks}


def span(curves: Sequence[Array]) -> dict[str, Any]:
    """A logarithmic y axis if the curves span more than a factor of 8."""
    values = np.concatenate([c[np.isfinite(c) & (c > 0)] for c in curves])
    wide = len(values) and values.max() > 8 * np.percentile(values, 5)
    return {"type": "log"} if wide else {}
