"""What a figure for papers shows, its axes and its legend."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from estbench.errors import EstbenchError, MissingExtraError, did_you_mean
from estbench.report.figures import palette
from estbench.report.figures.paper import WIDTHS
from estbench.report.sources import Entry

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None


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


def figure_of(paper: Paper, rows: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    """Rows and columns of axes, as wide as the paper's columns; `height` of a row in inches."""
    figure = Figure(figsize=(WIDTHS[paper.columns], height * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.ravel())


def grid(paper: Paper, count: int, height: float = 1.25) -> tuple[Figure, list[Axes]]:
    """Small axes, one per coordinate."""
    columns = min(count, 1 if paper.columns == 1 else 3 if count > 4 else 2)
    rows = -(-count // columns)
    figure, axes = figure_of(paper, rows, columns, height if rows > 1 else 1.7)
    for extra in axes[count:]:
        extra.remove()
    for ax in axes[max(0, count - columns) : count]:
        ax.set_xlabel("time (s)")
    return figure, axes[:count]


def style(index: int) -> dict[str, Any]:
    """Colour and line of the entry with that index."""
    return {
        "color": palette.colour(index),
        "linestyle": palette.LINES[index % len(palette.LINES)],
    }


def event_mark(kind: str) -> dict[str, Any]:
    """The look of an event of contact."""
    return {"ls": "none", "color": "#333333", "ms": 4, "marker": palette.EVENTS[kind][0]}


def legend(
    figure: Figure, paper: Paper, ax: Axes, band: str = "", marks: Iterable[str] = ()
) -> None:
    """The legend above the figure: entries, the grey band, and kinds of events."""
    handles: list[Any] = [
        ax.plot([], [], **style(k), label=e.key)[0] for k, e in enumerate(paper.entries)
    ]
    if band:
        handles.append(Patch(facecolor="#cccccc", lw=0, label=band))
    handles += [ax.plot([], [], **event_mark(kind), label=kind)[0] for kind in marks]
    columns = min(len(handles), 3 if paper.columns == 1 else 6)
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)
