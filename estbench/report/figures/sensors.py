"""`estbench sensors --out`: true and measured readings over time, one panel per axis."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstbenchError, MissingExtraError, StoreError
from estbench.experiment.setup import Setup
from estbench.report.sensor_table import latency, rate
from estbench.robots.batch import engine
from estbench.sensors.channel import Channel
from estbench.shapes import Array
from estbench.simulation.truth import simulate
from estbench.tables.destination import check_file

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of Okabe & Ito, one per axis."""
COLUMNS = 3
FORMATS = ("png", "pdf", "svg")


@dataclass(frozen=True, eq=False)
class Record:
    """One channel of one run; attitudes as rotation vectors from the first true one.

    Attributes:
        channel: the sensor.
        times: s, of `true`.
        true: noise-free readings `(time, m)`.
        taken: s, when each reading was taken.
        arrived: s, when it arrived.
        measured: the readings `(reading, m)`.
        lost: s, when the readings that never arrived were due.
    """

    channel: Channel
    times: Array
    true: Array
    taken: Array
    arrived: Array
    measured: Array
    lost: Array


def record(setup: Setup, seconds: float, run: int = 0) -> list[Record]:
    """The readings in the first seconds of one run; the controller sees the truth.

    Args:
        setup: of the scenario.
        seconds: duration; the run may be shorter.
        run: number of the run.

    Raises:
        EstbenchError: not even the first instant lies within `seconds`.
    """
    ends = np.array([i.end for i in setup.instants])
    shown = int(np.searchsorted(ends, seconds + 1e-9))
    if not shown:
        raise EstbenchError(f"--seconds is {seconds:g}; use at least {ends[0]:g}, one step")
    simulator, controller = setup.simulator([run]), setup.controller([run])
    with engine():
        trajectory = simulate(simulator, controller, setup.plant.period)
        records = []
        for channel in setup.channels:
            clean = np.concatenate([
                simulator.clean([channel], ends[k], trajectory.x[k + 1], trajectory.u[k])
                for k in range(shown)
            ])  # fmt: skip
            all_came = [
                (d.due, d.taken, k, d.y[0])
                for k, arrived in enumerate(trajectory.deliveries)
                for d in arrived
                if d.channel == channel.name and (d.mask is None or d.mask[0])
            ]
            due = {k for k in range(shown) if channel.name in setup.instants[k].channels}
            # A reading that may arrive after the end of the run is not lost.
            late = channel.timing.longest * channel.timing.timestep
            lost = [k for k in due - {c[0] for c in all_came} if ends[k] + late <= ends[-1]]
            came = [c for c in all_came if c[1] < shown]
            space, start = channel.space, clean[:1]
            y = np.array([c[3] for c in came]).reshape(len(came), space.nx)
            flat = space.flat
            records.append(
                Record(
                    channel,
                    ends[:shown],
                    clean if flat else space.minus(clean, start),
                    ends[[c[1] for c in came]],
                    ends[[c[2] for c in came]],
                    y if flat else space.minus(y, start),
                    ends[sorted(lost)],
                )
            )
    return records


def write(setup: Setup, path: Path, seconds: float = 3.0, run: int = 0) -> None:
    """Draw the channels into a file; its suffix is the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        EstbenchError: another suffix than png, pdf or svg.
        StoreError: the file cannot be written.
    """
    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise EstbenchError(f"--out '{path}' is no picture; end it in .{', .'.join(FORMATS)}")
    check_file(path)
    figure = draw(record(setup, seconds, run), f"{setup.scenario.name}, run {run}")
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise StoreError(f"{path} cannot be written: {error.strerror}; choose --out") from None


def draw(records: Sequence[Record], title: str) -> Any:
    """A matplotlib figure: true readings as lines, measured readings as points.

    A point is at the time when its reading was taken; with latency a thin line leads to the time of
    arrival. Lost readings are marks at the foot. Each axis has its own panel and scale.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "plot") from None
    rows = [
        (one, range(first, min(first + COLUMNS, one.channel.space.n)))
        for one in records
        for first in range(0, one.channel.space.n, COLUMNS)
    ]
    counts = [len(axes) for _, axes in rows]
    cells = 6  # one, two or three panels fit into a row
    # The time axis is labelled where the panels below have another width.
    timed = [counts[row : row + 2] != [count] * 2 for row, count in enumerate(counts)]
    width, height = 3.2 + 2.9 * max(counts), 0.7 + 1.7 * len(rows) + 0.3 * sum(timed)
    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.add_gridspec(len(rows), cells)
    shared = None
    for row, (one, axes) in enumerate(rows):
        for column, axis in enumerate(axes):
            span = cells // len(axes)
            place = grid[row, column * span : (column + 1) * span]
            shared = ax = figure.add_subplot(place, sharex=shared)
            letters = int(16 * width / len(axes)) - 10  # small ones are 1/16 inch wide
            _panel(ax, one, axis, letters if column == 0 else 0)
            ax.tick_params(labelsize="small", labelbottom=timed[row])
            ax.set_xlabel("time (s)" if timed[row] else "", fontsize="small")
    figure.axes[0].set_xlim(0.0, records[0].times[-1])
    figure.suptitle(textwrap.fill(f"{title}: {_key(records)}", int(13 * width)), fontsize="medium")
    return figure


def _key(records: Sequence[Record]) -> str:
    """The legend of the picture, in words."""
    signs = ["true (lines) and measured (points)"]
    signs += ["thin lines lead to the arrival"] if any(_late(r).any() for r in records) else []
    signs += ["marks at the foot are lost readings"] if any(len(r.lost) for r in records) else []
    return "; ".join(signs)


def _late(one: Record) -> NDArray[np.bool_]:
    """Whether each reading arrives later than it was taken `(reading,)`."""
    return one.arrived - one.taken > 1e-9


def _panel(ax: Any, one: Record, axis: int, letters: int) -> None:
    """One axis of one channel; with `letters` per line above 0 the title names the channel."""
    space, y = one.channel.space, one.measured[:, axis]
    colour = COLOURS[axis % len(COLOURS)]
    size = float(np.clip(90 / np.sqrt(len(one.taken) + 1), 3.0, 16.0))
    late = _late(one)
    if late.any():
        ax.hlines(y[late], one.taken[late], one.arrived[late], colour, lw=0.7, alpha=0.5)
    ax.plot(one.times, one.true[:, axis], color="#333333", linewidth=1.1, zorder=2)
    ax.scatter(one.taken, y, s=size, color=colour, alpha=0.7, linewidths=0, zorder=3)
    if len(one.lost):
        foot = ax.get_xaxis_transform()
        ax.vlines(one.lost, 0.0, 0.08, "#000000", lw=0.8, transform=foot)
    title = space.names[axis]
    if letters:
        title = textwrap.fill(f"{title}  ({', '.join(_described(one, title))})", letters)
    ax.set_title(title, loc="left", fontsize="small")
    if letters or space.units[axis] != space.units[axis - 1]:
        ax.set_ylabel(space.units[axis] + ("" if space.flat else " (rotation)"), fontsize="small")
    ax.locator_params(axis="y", nbins=5)  # whatever the height: the layout then is the final one
    ax.grid(color="#dddddd", linewidth=0.4)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _described(one: Record, axis: str) -> Iterator[str]:
    """The channel in words, with its name unless the axis begins with it."""
    channel = one.channel
    if not axis.startswith(channel.name):
        yield channel.name
    yield channel.kind
    yield f"{rate(channel):.4g} Hz"
    if latency(channel):
        yield f"{latency(channel)} late"
    if len(one.lost):
        yield f"{len(one.lost)} lost"
