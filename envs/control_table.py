"""The comparison of `estbench control` as a table."""

from rich.console import Group
from rich.text import Text

from estbench.envs.control import RAW, TRUTH, Comparison
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import quantity


def render(comparison: Comparison) -> Group:
    """The table for a rich console."""
    runs = len(comparison.sources[0].cost)
    title = (
        f"{comparison.scenario}: {comparison.controller} on truth, estimates and raw readings, "
        f"{runs} runs x {comparison.duration:g} s, seed {comparison.seed}"
    )
    labels = tuple(s.label for s in comparison.sources)
    failures = (int(s.failed.sum()) for s in comparison.sources)
    columns = (
        Column("cost", tuple(quantity(comparison.cost(label)) for label in labels)),
        Column("minus truth", _differences(comparison, labels, TRUTH)),
        Column("minus raw", _differences(comparison, labels, RAW)),
        Column("failed", tuple(Text(f"{n}/{runs}", style="red" if n else "") for n in failures)),
    )
    keys = (Column("controller sees", labels, "left"),)
    table = Table(keys, tuple((column,) for column in columns))
    caption = (
        "cost is the task's, mean per step, of the runs that did not fail. minus truth, minus\n"
        "raw: paired differences (common random numbers) of the runs that failed with neither.\n"
        f"± is the {comparison.level:.0%} interval across runs. A failed run left the bounds or\n"
        "is not finite. raw: coordinates from the sensors, other velocities by differences."
    )
    return Group(Text(title, style="bold"), table, Text(caption, style="dim italic"))


def _differences(
    comparison: Comparison, labels: tuple[str, ...], reference: str
) -> tuple[str, ...]:
    """Cells; there is none of the reference from itself."""
    return tuple(
        "" if label == reference else quantity(comparison.difference(label, reference))
        for label in labels
    )
