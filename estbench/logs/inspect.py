"""What is in a log: columns, rates, ranges, gaps; and a first section `[log]` for a robot."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Group
from rich.text import Text

from estbench.errors import LogError
from estbench.logs import bags, clock, files, matching
from estbench.logs.table import LogTable
from estbench.scenario.schema import Scenario
from estbench.tables.columns import tabulate
from estbench.tables.names import visible

WORDS = {
    "encoder": ("pos", "position", "angle", "q"),
    "speed": ("vel", "velocity", "speed", "qd", "omega"),
    "torque": ("tau", "torque", "effort", "u", "current", "ctrl", "control"),
    "gyro": ("gyro", "angular_velocity", "wx", "wy", "wz"),
    "accelerometer": ("acc", "accel", "linear_acceleration", "ax", "ay", "az"),
}
"""What parts of a heading say: the first word of each list is the usual one."""


@dataclass(frozen=True)
class Stamps:
    """The time stamps of a file.

    Attributes:
        column: their name.
        unit: that fits their differences: the median interval is then from 20 µs to 2 s.
        span: from the first to the last, s.
        median, longest: intervals, s.
        gaps: intervals above three medians.
        equal, backwards: stamps that are equal to, or before, the one before.
    """

    column: str
    unit: str
    span: float
    median: float
    longest: float
    gaps: int
    equal: int
    backwards: int


def stamps(table: LogTable) -> Stamps | None:
    """The time stamps of a file; None where no column has a usual name."""
    try:
        name = clock.find(table, None)
    except LogError:
        return None
    values = table.columns[name]
    steps = np.diff(values[np.isfinite(values)])
    rising = steps[steps > 0]
    if not len(rising):
        return None
    middle = float(np.median(rising))
    unit = next((u for u, s in clock.SECONDS.items() if 2e-5 < middle * s < 2.0), "s")
    factor = clock.SECONDS[unit]
    return Stamps(
        name, unit, float(np.nanmax(values) - np.nanmin(values)) * factor, middle * factor,
        float(rising.max()) * factor, int((rising > 3 * middle).sum()),
        int((steps == 0).sum()), int((steps < 0).sum()),
    )  # fmt: skip


def render(paths: Sequence[str | Path], scenario: Scenario | None = None) -> Group:
    """The columns of each file and a first `[log]`, for a rich console.

    Args:
        paths: the files.
        scenario: whose channels and actuators `[log]` has, by the columns that fit them.

    Raises:
        LogError: a file cannot be read.
    """
    tables = files.read_all(paths)
    parts = []
    for table in tables:
        seen = stamps(table)
        rows = [_row(name, table.columns[name]) for name in table.columns]
        rows += [[n, "text", *["-"] * 5] for n in table.texts]
        title = f"{table.path.name} {table.topic}".strip() + f": {len(table.rows)} rows"
        headings = ("<column", "<type", "least", "greatest", "changes by", "values", "missing")
        found = tabulate(title, headings, rows)
        parts += [Text(visible(title), style="bold"), found, Text(visible(_clock(seen)))]
    first = (
        "a first section, under the names of the columns; give them those of the robot:\n\n"
        if scenario is None
        else f"a first section for {scenario.name}, by names, units and ranges; check it:\n\n"
    )
    text = visible(first + section(tables, scenario), lines=True)
    parts.append(Text(text, no_wrap=True, overflow="ignore"))
    return Group(*parts)


def is_log(path: Path) -> bool:
    """Whether a path is that of a log, and of no scenario or MJCF."""
    return bags.is_bag(path) or (path.is_file() and path.suffix.lower() not in (".toml", ".xml"))


def _row(name: str, values: np.ndarray) -> list[str]:
    known = values[np.isfinite(values)]
    if not len(known):
        return [name, "number", "-", "-", "-", "0", str(len(values))]
    kind = "integer" if (known == np.round(known)).all() else "number"
    levels = np.unique(known)
    step = f"{np.diff(levels).min():.3g}" if len(levels) > 1 else "-"
    return [
        name, kind, f"{known.min():.5g}", f"{known.max():.5g}", step, str(len(known)),
        str(len(values) - len(known)),
    ]  # fmt: skip


def _clock(seen: Stamps | None) -> str:
    if seen is None:
        return f"no column of time stamps by one of the names {', '.join(clock.NAMES)}"
    return (
        f"time stamps in '{seen.column}', in {seen.unit} by their size: {seen.span:.6g} s, "
        f"{1 / seen.median:.5g} Hz by the median interval {1e3 * seen.median:.4g} ms, longest "
        f"{1e3 * seen.longest:.4g} ms; {seen.gaps} gaps above three medians, {seen.equal} equal, "
        f"{seen.backwards} out of order"
    )


def section(tables: Sequence[LogTable], scenario: Scenario | None = None) -> str:
    """A first `[log]` in TOML: what the headings say, to be corrected by hand."""
    seen = next((s for s in map(stamps, tables) if s is not None), None)
    lines = ["[log]"]
    if seen is not None:
        lines += [f'time = "{seen.column}"', f'unit = "{seen.unit}"']
    if scenario is not None:
        return "\n".join(lines) + "\n" + matching.section(tables, scenario)
    for table in tables:
        for name in table.columns:
            word = _word(name)
            if word is None or (seen is not None and name == seen.column):
                continue
            kind = "controls" if word == "torque" else "channels"
            lines += ["", f"[log.{kind}.{matching.key(name)}]"]
            lines += [f'columns = ["{name}"]']
            if _degrees(name, table.columns[name], word):
                lines += ['unit = "deg"' if word == "encoder" else 'unit = "deg/s"']
    return "\n".join(lines)


def _word(name: str) -> str | None:
    """What a heading says of its column."""
    parts = "".join(c if c.isalpha() else " " for c in name.lower()).split()
    for word, known in WORDS.items():
        if any(part in known for part in parts) or any(k in name.lower() for k in known[1:2]):
            return word
    return None


def _degrees(name: str, values: np.ndarray, word: str) -> bool:
    if word not in ("encoder", "speed", "gyro"):
        return False
    largest = float(np.nanmax(np.abs(values)))
    return "deg" in name.lower() or largest > (30.0 if word == "encoder" else 200.0)
