"""`estbench sensors --out`: true and measured readings over a few seconds."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstbenchError, MissingExtraError, StoreError
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import trajectory
from estbench.sensors.channel import Channel
from estbench.sensors.delivery import divided
from estbench.sensors.description import ChannelDescription
from estbench.shapes import Array
from estbench.tables.destination import check_file

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Palette of Okabe & Ito; one colour per axis."""
COLUMNS = 3
FORMATS = ("png", "pdf", "svg")


@dataclass(frozen=True, eq=False)
class Record:
    """One channel in one run; attitudes are rotation vectors from the first true attitude.

    Attributes:
        channel: the channel.
        times: times of `true` `(time,)`, s.
        true: noise-free readings `(time, m)`.
        taken: sampling time of each reading `(reading,)`, s.
        arrived: arrival time of each reading `(reading,)`, s.
        measured: the readings `(reading, m)`.
        lost: due times of the lost readings, s.
    """

    channel: Channel
    times: Array
    true: Array
    taken: Array
    arrived: Array
    measured: Array
    lost: Array


def record(setup: Setup, seconds: float, run: int = 0) -> list[Record]:
    """The readings of one run in its first seconds.

    A controller that sees the estimate under test sees the true state here.

    Args:
        setup: the scenario as objects.
        seconds: time to record, s; the run may be shorter.
        run: number of the run.

    Raises:
        EstbenchError: `seconds` ends before the first instant.
    """
    ends = np.array([i.end for i in setup.instants])
    shown = int(np.searchsorted(ends, seconds + 1e-9))
    if not shown:
        raise EstbenchError(f"--seconds is {seconds:g}; use at least {ends[0]:g}, one step")
    timestep = float(setup.plant.model.opt.timestep)
    simulator, seen = setup.simulator([run]), trajectory(setup, [run])
    records = []
    for channel in setup.channels:
        clean = np.concatenate([
            simulator.suite.clean([channel], ends[k], seen.x[k + 1], seen.u[k])
            for k in range(shown)
        ])  # fmt: skip
        arrivals = [
            (int(np.ravel(d.due)[0]), d.taken, k, d.y[0])
            for k, arrived in enumerate(seen.deliveries)
            for d in divided(arrived)
            if d.channels == (channel.name,) and (d.mask is None or d.mask[0])
        ]
        due = {i.tick: i.end for i in setup.instants[:shown] if channel.name in i.channels}
        # What is still under way when the run ends is not lost.
        late = channel.timing.longest_delay * timestep
        missing = due.keys() - {tick for tick, *_ in arrivals}
        lost = [due[tick] for tick in missing if due[tick] + late <= ends[-1]]
        came = [c for c in arrivals if c[1] <= setup.instants[shown - 1].tick]
        space, start = channel.space, clean[:1]
        y = np.array([c[3] for c in came]).reshape(len(came), space.nx)
        flat = space.flat
        records.append(
            Record(
                channel,
                ends[:shown],
                _drawn(clean) if flat else space.minus(clean, start),
                timestep * np.array([c[1] for c in came]),
                ends[[c[2] for c in came]],
                _drawn(y) if flat else space.minus(y, start),
                np.array(sorted(lost)),
            )
        )
    return records


def _drawn(readings: Array) -> Array:
    """Readings with a gap where there is no return."""
    return np.where(np.isinf(readings), np.nan, readings)


def write(setup: Setup, path: Path, seconds: float = 3.0, run: int = 0) -> None:
    """Draw the channels into a file, whose suffix gives the format.

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

    A point stands at the sampling time; with latency, a thin line leads to the arrival time. Marks
    at the lower edge are lost readings. Each axis has its own panel and scale.

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
    """The meaning of the lines, points and marks."""
    signs = ["true (lines) and measured (points)"]
    signs += ["thin lines lead to the arrival"] if any(_late(r).any() for r in records) else []
    signs += ["marks at the foot are lost readings"] if any(len(r.lost) for r in records) else []
    return "; ".join(signs)


def _late(one: Record) -> NDArray[np.bool_]:
    """Whether each reading arrives after its sampling time `(reading,)`."""
    return one.arrived - one.taken > 1e-9


def _panel(ax: Any, one: Record, axis: int, letters: int) -> None:
    """One axis of one channel; the title describes the channel unless `letters` per line is 0."""
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
    ax.locator_params(
        axis="y", nbins=5
    )  # a fixed count, so that the layout does not depend on the height
    ax.grid(color="#dddddd", linewidth=0.4)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _described(one: Record, axis: str) -> Iterator[str]:
    """The description of the channel; with its name unless the axis name begins with it."""
    channel = one.channel
    if not axis.startswith(channel.name):
        yield channel.name
    yield ChannelDescription.of(channel).summary
    if len(one.lost):
        yield f"{len(one.lost)} lost"
