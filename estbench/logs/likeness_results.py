"""The table of a log beside simulated runs, and its numbers for JSON."""

import json
from typing import Any

import numpy as np
from rich.console import Group
from rich.text import Text

from estbench.logs.likeness import Comparison, Likeness
from estbench.tables.cells import plain
from estbench.tables.columns import Table, tabulate
from estbench.tables.names import visible
from estbench.tables.quantity import number


def table(found: Likeness) -> Table:
    """One row for each statistic."""
    rows = [
        [t.component, t.name, t.unit, number(t.log), number(float(np.median(t.runs))),
         number(float(t.runs.min())), number(float(t.runs.max())), "differs" if t.differs else ""]
        for t in found.traits
    ]  # fmt: skip
    headings = ("<component", "<statistic", "<unit", "log", "median run", "least", "greatest", "<")
    note = "spectrum: of innovation/σ, 1 where it is white; least and greatest of all runs"
    shown = tabulate(found.label, headings[:-1], [row[:-1] for row in rows], note)
    mark = tabulate("", ("<", "<"), [["", row[-1]] for row in rows]).keys[1]
    return Table(shown.keys, (*shown.groups, (mark,)), shown.title, shown.note)


def words(found: Likeness) -> str:
    """How many statistics differ, and how many would by chance."""
    count, runs = len(found.traits), len(found.traits[0].runs)
    chance = 2 / (runs + 1)
    differing = len(found.differing)
    return (
        f"{found.label}: {differing} of {count} statistics of the log are outside of all {runs} "
        f"runs; by chance each is with probability {chance:.1%}"
    )


def render(found: Comparison) -> Group:
    """The tables for a rich console."""
    log = found.log
    source = ", ".join(dict.fromkeys(part.table.path.name for part in log.channels))
    parts: list[Any] = [
        Text(visible(f"{found.prepared.scenario.name} like {source}: {log.duration:.6g} s, "
             f"{len(log.instants)} instants, {found.runs} simulated runs"), style="bold"),
    ]  # fmt: skip
    parts += [Text(visible(f"note: {line}"), style="yellow") for line in log.notices]
    for one in found.found:
        shown = table(one)
        parts += [Text(shown.title, style="bold"), shown, Text(shown.note, style="dim")]
        parts.append(Text(visible(words(one))))
        if one.failed:
            parts.append(Text(f"{one.failed} runs failed and are left out", style="red"))
    return Group(*parts)


def to_json(found: Comparison) -> str:
    """Statistics and spectra as JSON text; a value that is not finite becomes null."""
    return json.dumps(
        {
            "scenario": found.prepared.scenario.name,
            "duration_s": found.log.duration,
            "runs": found.runs,
            "estimators": {one.label: _plain(one) for one in found.found},
        },
        indent=2,
        allow_nan=False,
    )


def _plain(found: Likeness) -> dict[str, Any]:
    return {
        "failed": found.failed,
        "statistics": [
            {
                "component": t.component, "name": t.name, "unit": t.unit, "log": plain(t.log),
                "runs": [plain(float(x)) for x in t.runs], "differs": bool(t.differs),
            }
            for t in found.traits
        ],
        "spectra": {
            s.component: {
                "frequency_hz": s.frequency.tolist(), "log_per_hz": s.log.tolist(),
                "median_run_per_hz": np.median(s.runs, axis=1).tolist(),
            }
            for s in found.spectra
        },
    }  # fmt: skip
