"""The tables of `estbench sensors`: the channels of a scenario and what the filter believes."""

from collections.abc import Iterator, Sequence

from rich.console import Group
from rich.text import Text

from estbench.experiment.prepared import Setup
from estbench.sensors.description import HEADINGS, ChannelDescription, describe
from estbench.tables.columns import Column, Table
from estbench.tables.names import visible


def render(setup: Setup) -> Group:
    """The channels, what the filter believes of them, and the notices, for a rich console."""
    section = setup.scenario.filter
    described = describe(setup.channels, section)
    rows = [channel.row() for channel in described]
    columns = tuple(
        Column(
            heading,
            tuple(row[i] for row in rows),
            "right" if heading in ("noise σ", "rate", "latency") else "left",
            wraps=heading == "imperfections",
        )
        for i, heading in enumerate(HEADINGS)
    )
    table = Table(columns[:1], (columns[1:],))
    lines = [Text(line) for line in _beliefs(described, section.measurement_noise_scale)]
    lines += [Text(setup.sight)] if setup.sight else []
    lines += [Text(visible(f"note: {notice}"), style="dim") for notice in setup.notices]
    return Group(Text(visible(setup.scenario.name), style="bold"), table, *lines)


def _beliefs(described: Sequence[ChannelDescription], scale: float) -> Iterator[str]:
    """A line for each channel of which the filter believes something other than the truth."""
    for channel in described:
        if channel.belief:
            yield f"the filter believes of {channel.name}: {', '.join(channel.belief)}"
    if scale != 1.0:
        yield f"the filter believes R x {scale:g} of every channel"
