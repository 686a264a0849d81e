"""The comparison of `estbench control` as a table."""

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from estbench.consistency import Interval
from estbench.envs.control import RAW, TRUTH, Comparison


def render(comparison: Comparison) -> Group:
    """The table for a rich console."""
    runs = len(comparison.sources[0].cost)
    title = (
        f"{comparison.scenario}: {comparison.controller} on truth, estimates and raw readings, "
        f"{runs} runs x {comparison.duration:g} s, seed {comparison.seed}"
    )
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    table.add_column("controller sees", no_wrap=True)
    for heading in ("cost", "minus truth", "minus raw", "failed"):
        table.add_column(heading, justify="right", no_wrap=True)
    for source in comparison.sources:
        label, failures = source.label, int(source.failed.sum())
        table.add_row(
            label,
            number(comparison.cost(label)),
            "" if label == TRUTH else number(comparison.difference(label, TRUTH)),
            "" if label == RAW else number(comparison.difference(label, RAW)),
            Text(f"{failures}/{runs}", style="red" if failures else ""),
        )
    caption = (
        "cost is the task's, mean a step, of the runs that did not fail. minus truth, minus raw:\n"
        "paired differences (same robot, same noise) over the runs that failed with neither.\n"
        f"± is the {comparison.level:.0%} interval across runs. A failed run left the bounds\n"
        "or blew up. raw: coordinates read off the sensors, other velocities differenced."
    )
    return Group(Text(title, style="bold"), table, Text(caption, style="dim italic"))


def number(i: Interval) -> str:
    """`0.0123 ± 0.0004`: as many digits as the half-width has meaning; `-` for no run at all."""
    if not np.isfinite(i.value):
        return "-"
    half = 0.5 * (i.high - i.low)
    if not np.isfinite(half) or half <= 0:
        return f"{i.value:.3g}"
    decimals = int(np.clip(1 - np.floor(np.log10(half)), 0, 9))
    return f"{i.value:.{decimals}f} ± {half:.{decimals}f}"
