"""The result of a tuning: tables, JSON, and the scenario that is ready to run."""

import json
import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from rich.console import Group
from rich.text import Text

from estbench.consistency.intervals import Interval
from estbench.scenario.schema import Scenario
from estbench.study import keys
from estbench.tables import writers
from estbench.tables.cells import plain
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number, quantity
from estbench.tuning.parameters import Parameter
from estbench.tuning.problem import Step
from estbench.tuning.uncertainty import Profile, Uncertainty, in_words, interval

WIDTH = 100


class Proof(Protocol):
    """The filter before and after on what the tuning has not seen."""

    def head(self, level: float) -> str:
        """What it is, and what its tables compare."""
        ...

    def tables(self) -> list[Table]:
        """Before and after."""
        ...

    def words(self) -> list[str]:
        """What the reader should know."""
        ...

    def lines(self) -> list[str]:
        """For the header of the tuned scenario."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        ...


@dataclass(frozen=True, eq=False)
class Tuned:
    """What `estbench.tune` returns; `print(tuned)` shows the tables.

    Attributes:
        scenario: with the tuned values, ready to run.
        label: of the estimator.
        objective: `likelihood`, `mse` or `consistent-mse`.
        method: of the search.
        parameters: the free ones, with their values before.
        values: their values after.
        point: their coordinates in the search.
        loss: before and after, mean over the tuning runs.
        runs, seed: of the tuning; blocks of time in place of runs where it was on logs.
        batches, candidates: how many sets of candidates were asked for, and candidates.
        trace: of the search.
        uncertainty: from the curvature; None where there is none (choices, an interrupted search).
        profiles: of each parameter, likewise.
        held_out: before and after on other runs or logs; None if not asked for, or interrupted.
        interrupted: whether Ctrl-C ended the search.
        refused: candidates that failed -> how many, by reason.
        folder: of what was written, or None.
        logs: names of the recorded logs that it was tuned on; none where runs were simulated.
    """

    scenario: Scenario
    label: str
    objective: str
    method: str
    parameters: tuple[Parameter, ...]
    values: tuple[Any, ...]
    point: tuple[float, ...]
    loss: tuple[float, float]
    runs: int
    seed: int
    batches: int
    candidates: int
    trace: tuple[Step, ...]
    uncertainty: Uncertainty | None = None
    profiles: tuple[Profile, ...] = ()
    held_out: Proof | None = None
    interrupted: bool = False
    refused: dict[str, int] = field(default_factory=dict)
    folder: Path | None = None
    logs: tuple[str, ...] = ()

    def __getitem__(self, key: str) -> Any:
        """The tuned value of a free parameter."""
        return {p.key: v for p, v in zip(self.parameters, self.values)}[key]

    def __str__(self) -> str:
        return writers.printed(self.render(), width=WIDTH)

    @property
    def data(self) -> str:
        """What it was tuned on, in words."""
        if self.logs:
            return f"on {', '.join(self.logs)} in {self.runs} blocks of time"
        return f"{self.runs} runs, seed {self.seed}"

    @property
    def level(self) -> float:
        """Confidence of the intervals."""
        return self.scenario.consistency.level

    @property
    def intervals(self) -> tuple[Interval | None, ...]:
        """Of the tuned values; None for what is no number."""
        found = self.uncertainty
        return tuple(
            None if p.kind == "choice" or found is None
            else interval(p, x, float(found.std[i]), self.level)
            for i, (p, x) in enumerate(zip(self.parameters, self.point))
        )  # fmt: skip

    @property
    def words(self) -> list[str]:
        """What the reader should know: flat directions, over-fitting, failed candidates."""
        out = [] if self.uncertainty is None else in_words(self.parameters, self.uncertainty)
        held = self.held_out
        out += [] if held is None else held.words()
        out += [f"{n} candidates failed: {reason}" for reason, n in self.refused.items()]
        return out

    def render(self) -> Group:
        """The tables for a rich console."""
        head = (
            f"{self.scenario.name}: {self.label} tuned by {self.objective} ({self.method}), "
            f"{self.data}, {self.candidates} candidates in {self.batches} sets"
        )
        if self.interrupted:
            head += " [interrupted: the best so far]"
        parts: list[Any] = [Text(head, style="bold"), self._values()]
        if self.held_out is not None:
            parts += [Text(self.held_out.head(self.level)), *self.held_out.tables()]
        parts += [Text(textwrap.fill(line, 90), style="yellow") for line in self.words]
        if self.folder is not None:
            parts.append(Text(f"written to {self.folder}"))
        return Group(*parts)

    def _values(self) -> Table:
        after, robust = [], []
        for i, (value, found) in enumerate(zip(self.values, self.intervals)):
            real = isinstance(value, int | float) and not isinstance(value, bool)
            shown = number(float(value)) if real else str(value)
            after.append(shown if found is None else quantity(found))
            spread = None if self.uncertainty is None else self.uncertainty.robust[i]
            other = (
                None
                if found is None or spread is None
                else interval(self.parameters[i], self.point[i], float(spread), self.level)
            )
            robust.append("" if other is None else quantity(other))
        before = tuple(
            f"{p.start:.4g}" if isinstance(p.start, int | float) else str(p.start)
            for p in self.parameters
        )
        columns = [
            (Column("before", before),), (Column("after", tuple(after)),),
            (Column("robust interval", tuple(robust)),),
        ]  # fmt: skip
        kept = columns if any(robust) else columns[:2]
        return Table((Column("free", tuple(p.key for p in self.parameters), "left"),), tuple(kept))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        held = self.held_out
        return {
            "scenario": self.scenario.name, "estimator": self.label,
            "objective": self.objective, "method": self.method, "runs": self.runs,
            "seed": self.seed, "logs": list(self.logs), "interrupted": self.interrupted,
            "sets_of_candidates": self.batches, "candidates": self.candidates,
            "loss": {"before": plain(self.loss[0]), "after": plain(self.loss[1])},
            "parameters": {
                p.key: {
                    "before": p.start, "after": v,
                    "interval": None if i is None else plain(i),
                }
                for p, v, i in zip(self.parameters, self.values, self.intervals)
            },
            "words": self.words,
            "trace": [
                {"values": list(s.values), "loss": plain(s.loss), "candidates": s.candidates}
                for s in self.trace
            ],
            "held_out": None if held is None else held.to_dict(),
        }  # fmt: skip

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, default=str)

    def to_toml(self) -> str:
        """The tuned scenario with a header of what was done; `estbench run` takes the file."""
        lines = [
            f"{self.label} tuned by estbench: objective {self.objective}, search {self.method}, "
            f"{self.data}, {self.candidates} candidates.",
            f"Mean loss per {'block' if self.logs else 'run'}: {self.loss[0]:.6g} before, "
            f"{self.loss[1]:.6g} after.",
        ]
        for p, v, i in zip(self.parameters, self.values, self.intervals):
            shown = "" if i is None else f", {self.level:.0%} interval {quantity(i)}"
            lines.append(f"{p.key}: {p.start} -> {v}{shown}")
        held = self.held_out
        if held is not None:
            lines += held.lines()
        lines += self.words
        if self.interrupted:
            lines.append("The search was interrupted: these are the best values so far.")
        header = "\n".join(f"# {' '.join(line.split())}" for line in lines)
        return f"{header}\n\n{self.scenario.to_toml()}"


def tuned_scenario(
    scenario: Scenario, parameters: tuple[Parameter, ...], values: tuple[Any, ...]
) -> Scenario:
    """The scenario with the tuned values."""
    return keys.changed(scenario, {p.names: v for p, v in zip(parameters, values)})
