"""The results of one experiment: what Python gets back, and what is printed."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console, Group
from rich.text import Text

from estbench.consistency.nees import Interval, Verdict
from estbench.consistency.records import Record
from estbench.consistency.summary import Summary
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.tables.columns import Column, Columns
from estbench.tables.quantity import LARGE, quantity

WIDTH = 100
COLOURS = {
    Verdict.CONSISTENT: "green",
    Verdict.OVERCONFIDENT: "red",
    Verdict.CONSERVATIVE: "yellow",
    Verdict.DIVERGING: "bold red",
    Verdict.UNDECIDED: "dim",
}


@dataclass(frozen=True, eq=False)
class Results:
    """What `estbench.run` returns; `print(results)` shows the tables.

    Attributes:
        scenario: as resolved.
        names, units: of the tangent coordinates.
        times: instants, s.
        steps: control steps of a run; readings between them make more instants.
        runs: numbers of the finished runs.
        summaries: one an estimator.
        records: label -> per-run and per-step arrays (`records.SUMMARY`).
        notices: what was assumed where the scenario is silent.
        folder: where it was written, or None.
        interrupted: whether Ctrl-C cut it short.
        failed: batches that could not be computed; a notice says why.
    """

    scenario: Scenario
    names: tuple[str, ...]
    units: tuple[str, ...]
    times: Array
    steps: int
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
        console = Console(width=WIDTH, no_color=True, force_terminal=False, highlight=False)
        with console.capture() as capture:
            console.print(self.render())
        return "\n".join(line.rstrip() for line in capture.get().splitlines())

    @property
    def length(self) -> str:
        """How long a run is: control steps, and instants where readings fall between them."""
        instants = len(self.times) - 1
        between = "" if instants == self.steps else f", {instants} instants"
        return f"{self.steps} steps{between}"

    def render(self) -> Group:
        """The tables for a rich console."""
        simulation = self.scenario.simulation
        done = len(self.runs)
        title = (
            f"{self.scenario.name}: {done} runs x {self.times[-1]:g} s ({self.length}), "
            f"seed {simulation.seed}"
        )
        if self.interrupted:
            title += f" [interrupted: {done} of {simulation.runs} runs finished]"
        parts: list[Any] = [Text(title, style="bold")]
        parts += [Text(f"note: {notice}", style="dim") for notice in self.notices]
        parts += [_verdicts(self.summaries, self.scenario.consistency.level)]
        parts += [_accuracy(self.summaries, self.names, self.units)]
        parts += [Text(line, style="red") for line in _failures(self.summaries)]
        parts += [Text(line, style="yellow") for line in _late(self.summaries)]
        if self.folder is not None:
            parts.append(Text(f"written to {self.folder}"))
            if self.interrupted:
                parts.append(Text(f"go on with --out {self.folder} --resume"))
        return Group(*parts)

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
                    "anees_over_n": _plain(s.anees),
                    "anees_over_n_median": _number(s.anees_median),
                    "anis_over_m": _plain(s.anis),
                    "innovation_lag_one": _plain(s.lag_one),
                    "diverged_share": s.diverged,
                    "diverged_interval": _plain(s.diverged_interval),
                    "cost_us_per_run_step": s.cost,
                    "rmse": {
                        name: {"unit": unit, **_plain(i), "median": _number(m), "sigma": _number(d)}
                        for name, unit, i, m, d in zip(
                            self.names, self.units, s.rmse, s.rmse_median, s.std
                        )
                    },
                    "failures": [vars(f) for f in s.failures],
                    "late_readings": s.late,
                }
                for s in self.summaries
            },
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False)


def _verdicts(summaries: tuple[Summary, ...], level: float) -> Group:
    columns = (
        _column("estimator", (s.label for s in summaries), "left"),
        _column(
            "verdict", (Text(str(s.verdict), style=COLOURS[s.verdict]) for s in summaries), "left"
        ),
        _column("NEES/n", (quantity(s.anees) for s in summaries)),
        _column("median", (_short(s.anees_median) for s in summaries)),
        _column("NIS/m", (quantity(s.anis) for s in summaries)),
        _column("lag-one", (quantity(s.lag_one) for s in summaries)),
        _column("diverged", (f"{s.diverged:.1%}" for s in summaries)),
        Column("µs/run-step", tuple(f"{s.cost:.3g}" for s in summaries), narrow="µs/step"),
    )
    return Group(
        Columns(columns[:1], tuple((column,) for column in columns[1:])),
        Text(
            "NEES/n and NIS/m are 1, the innovations' lag-one correlation is 0, for a consistent\n"
            f"filter; ± and brackets: the {level:.0%} interval across runs; cost: of one core, "
            "a run and step.",
            style="dim",
        ),
    )


def _accuracy(
    summaries: tuple[Summary, ...], names: tuple[str, ...], units: tuple[str, ...]
) -> Group:
    detailed = len(summaries) <= 3
    keys = _column("coordinate", names, "left"), _column("unit", units, "left")
    groups = []
    for s in summaries:
        heading = f"{s.label} RMSE" if detailed else s.label
        values = tuple(f"{i.value:.3g}" for i in s.rmse)
        group = [Column(heading, values, narrow=heading.replace(" ", "\n"))]
        if detailed:
            group.append(_column("σ", (f"{x:.3g}" for x in s.std)))
            group.append(_column("median", (f"{x:.3g}" for x in s.rmse_median)))
        groups.append(tuple(group))
    more = "; σ is what the filter\nreports; median is that of all runs." if detailed else "."
    text = f"RMSE over time and the runs that did not diverge{more}"
    return Group(Columns(keys, tuple(groups)), Text(text, style="dim"))


def _column(
    heading: str, cells: Iterable[str | Text], justify: Literal["left", "right"] = "right"
) -> Column:
    return Column(heading, tuple(cells), justify)


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


def _short(x: float) -> str:
    return f"{x:.3f}" if abs(x) < LARGE else f"{x:.2e}"


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _plain(i: Interval) -> dict[str, float | None]:
    return {"value": _number(i.value), "low": _number(i.low), "high": _number(i.high)}
