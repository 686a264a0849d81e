"""The results of one experiment: what `estbench.run` returns and the command prints."""

import json
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.text import Text

from estbench.consistency import statistics
from estbench.consistency.fields import Record
from estbench.consistency.phases import InPhase, by_phase
from estbench.consistency.statistics import COST, RMSE, Summary
from estbench.consistency.summary import exactly_known
from estbench.consistency.verdict import Verdict
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.tables import phases as phase_table
from estbench.tables import writers
from estbench.tables.cells import (
    cell,
    lost_note,
    of_summary,
    per_coordinate,
    plain,
    value_of,
)
from estbench.tables.columns import Column, Table
from estbench.tables.names import visible

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

WIDTH = 100
NOTE_WIDTH = 90
"""Of the text under a table."""
COLOURS = {
    Verdict.CONSISTENT: "green",
    Verdict.OVERCONFIDENT: "red",
    Verdict.BIASED: "red",
    Verdict.CONSERVATIVE: "yellow",
    Verdict.CORRELATED: "yellow",
    Verdict.DIVERGING: "bold red",
    Verdict.SIMULATION_FAILED: "bold magenta",
    Verdict.UNDECIDED: "dim",
}


@dataclass(frozen=True, eq=False)
class Results:
    """What `estbench.run` returns; `print(results)` shows the tables.

    Attributes:
        scenario: as resolved.
        names, units: of the tangent coordinates.
        times: instants, s; of a long run those of a sample (`experiment.long`).
        steps: control steps of each run; readings between them add instants.
        instants: of each run.
        runs: numbers of the finished runs.
        summaries: one per estimator.
        records: label -> per-run and per-step arrays (`records.SUMMARY`).
        notices: assumptions where the scenario says nothing, and warnings.
        folder: of the stored results, or None.
        interrupted: whether Ctrl-C cut it short.
        failed: batches that could not be computed; a notice says why.
    """

    scenario: Scenario
    names: tuple[str, ...]
    units: tuple[str, ...]
    times: Array
    steps: int
    instants: int
    runs: tuple[int, ...]
    summaries: tuple[Summary, ...]
    records: dict[str, Record]
    notices: tuple[str, ...]
    folder: Path | None
    interrupted: bool
    failed: int = 0

    def __getitem__(self, label: str) -> Summary:
        return {s.label: s for s in self.summaries}[label]

    def __str__(self) -> str:
        return writers.printed(self.render(), width=WIDTH)

    @property
    def length(self) -> str:
        """Length of each run: control steps, and instants if readings fall between steps."""
        between = "" if self.instants == self.steps else f", {self.instants} instants"
        return f"{self.steps} steps{between}"

    def render(self) -> Group:
        """The tables for a rich console."""
        simulation = self.scenario.simulation
        done = len(self.runs)
        title = (
            f"{visible(self.scenario.name)}: {done} runs x {self.times[-1]:g} s ({self.length}), "
            f"seed {simulation.seed}"
        )
        if self.interrupted:
            title += f" [interrupted: {done} of {simulation.runs} runs finished]"
        parts: list[Any] = [Text(title, style="bold")]
        parts += [Text(visible(f"note: {notice}"), style="dim") for notice in self.notices]
        parts += [_verdicts(self.summaries, self.scenario.consistency.level)]
        parts += [
            Text(visible(f"{s.label}: {s.reason}"), style=COLOURS[s.verdict])
            for s in self.summaries
            if s.reason
        ]
        parts += [_accuracy(self.summaries, self.names, self.units)]
        parts += self._by_phase()
        parts += [Text(visible(line), style="dim") for line in _known(self.summaries, self.names)]
        parts += [Text(visible(line), style="red") for line in _failures(self.summaries)]
        lines = (*_late(self.summaries), *_gated(self.summaries))
        parts += [Text(line, style="yellow") for line in lines]
        if self.folder is not None:
            parts.append(Text(f"written to {self.folder}"))
            if self.interrupted:
                parts.append(Text(f"go on with --out {self.folder} --resume"))
        return Group(*parts)

    def phases(self, label: str) -> tuple[InPhase, ...]:
        """The statistics of an estimator by phase of contact; empty without contacts."""
        return by_phase(self.records[label], self.units, self.scenario.consistency.level)

    def _by_phase(self) -> list[Any]:
        table = phase_table.table((s.label, self.phases(s.label)) for s in self.summaries)
        if table is None:
            return []
        return [table, Text(textwrap.fill(table.note, NOTE_WIDTH), style="dim")]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON; a value that is not finite becomes None."""
        return {
            "scenario": self.scenario.name,
            "seed": self.scenario.simulation.seed,
            "runs": len(self.runs),
            "duration_s": float(self.times[-1]),
            "interrupted": self.interrupted,
            "folder": None if self.folder is None else str(self.folder),
            "notices": list(self.notices),
            "estimators": {
                s.label: {
                    "verdict": str(s.verdict),
                    "reason": s.reason,
                    **_plain(s),
                    **per_coordinate(s, statistics.of("coordinate"), self.names, self.units),
                    "phases": phase_table.numbers(self.phases(s.label)),
                    "failures": [vars(f) for f in s.failures],
                    "late_readings": s.late,
                    "known_exactly": {n: x for n, x in zip(self.names, s.known) if x > 0},
                }
                for s in self.summaries
            },
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False)

    def to_xarray(self) -> "xr.DataTree":
        """What was kept of each run; see `labelled.to_xarray`."""
        from estbench.montecarlo import labelled

        return labelled.to_xarray(self)

    def to_dataframe(self) -> "pd.DataFrame":
        """One row for each estimator and run; see `labelled.to_dataframe`."""
        from estbench.montecarlo import labelled

        return labelled.to_dataframe(self)


def _plain(summary: Summary) -> dict[str, Any]:
    """The statistics without a value per coordinate; the interval of a share has its own key."""
    out = {}
    for s in statistics.of("run"):
        value = value_of(summary, s)
        if s.form == "share":
            interval = f"{s.json_key.removesuffix('_share')}_interval"
            out |= {s.json_key: value.value, interval: plain(value)}
        else:
            out[s.json_key] = plain(value)
    return out


def _verdicts(summaries: tuple[Summary, ...], level: float) -> Group:
    verdicts = tuple(Text(str(s.verdict), style=COLOURS[s.verdict]) for s in summaries)
    columns = [
        Column(
            s.heading_in("run"),
            tuple(cell(s, value_of(summary, s), s.places["run"]) for summary in summaries),
            narrow=s.narrow,
        )
        for s in statistics.shown("run", summaries=summaries)
    ]
    table = Table(
        (Column("estimator", tuple(s.label for s in summaries), "left"),),
        ((Column("verdict", verdicts, "left"),), *((column,) for column in columns)),
    )
    note = (
        f"{statistics.ideals('run')}, for a consistent filter; ± and brackets: the {level:.0%} "
        f"interval across runs; {COST.note}."
    )
    return Group(table, Text(textwrap.fill(note, NOTE_WIDTH), style="dim"))


def _accuracy(
    summaries: tuple[Summary, ...], names: tuple[str, ...], units: tuple[str, ...]
) -> Group:
    """Statistics per coordinate; estimators that do not fit go on in a table below."""
    # First the statistics over the same runs as RMSE, then those over all runs.
    found = sorted(statistics.shown("run", "coordinate", summaries), key=lambda s: s.all_runs)
    groups = []
    for summary in summaries:
        group = []
        for s in found:
            heading = f"{summary.label} {s.heading}" if s is RMSE else s.heading
            cells = tuple(of_summary(summary, s, x, s.places["run"]) for x in value_of(summary, s))
            narrow = heading.replace(" ", "\n") if s is RMSE else s.narrow
            group.append(Column(heading, cells, narrow=narrow))
        groups.append(tuple(group))
    keys = Column("coordinate", names, "left"), Column("unit", units, "left")
    notes = [*(s.note for s in found if s.note), *lost_note(summaries)]
    note = textwrap.fill(f"{'; '.join(notes)}.", NOTE_WIDTH - 15)
    return Group(Table(keys, tuple(groups)), Text(note, style="dim"))


def _known(summaries: tuple[Summary, ...], names: tuple[str, ...]) -> list[str]:
    """What is known exactly, estimators of which the same is to be said together."""
    said: dict[str, list[str]] = {}
    for s in summaries:
        if note := exactly_known(s, names):
            said.setdefault(note, []).append(s.label)
    return [f"note: {', '.join(labels)}: {note}" for note, labels in said.items()]


def _failures(summaries: tuple[Summary, ...], most: int = 3) -> list[str]:
    lines = []
    for s in summaries:
        for f in s.failures[:most]:
            lines.append(f"{s.label}: run {f.run} failed at t = {f.time:g} s: {f.reason}")
        if len(s.failures) > most:
            lines.append(f"{s.label}: ... and {len(s.failures) - most} more failed runs")
    return lines


def _late(summaries: tuple[Summary, ...]) -> list[str]:
    return [
        f"note: {s.label}: {s.late} readings came later than filter.window and were not fused"
        for s in summaries
        if s.late
    ]


def _gated(summaries: tuple[Summary, ...]) -> list[str]:
    return [
        f"note: {s.label}: its gate refused {s.gated:.2%} of the components of the readings; they "
        "count in NIS and log-likelihood"
        for s in summaries
        if s.gated
    ]
