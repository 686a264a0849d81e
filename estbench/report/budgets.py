"""The linear error budgets of the estimators of a report, computed from their scenarios."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.budgets import budget, tables
from estbench.budgets.result import Budget
from estbench.budgets.sources import Source
from estbench.errors import EstbenchError
from estbench.experiment.setup import build
from estbench.report.sources import Entry
from estbench.shapes import Array, Float
from estbench.tables.columns import Table


@dataclass(frozen=True, eq=False)
class EntryBudget:
    """The budget of one estimator.

    Attributes:
        key: of the entry.
        index: of the entry.
        found: the budget; None where there is none.
        table: its shares.
        reason: why there is none, else "".
    """

    key: str
    index: int
    found: Budget | None
    table: Table | None = None
    reason: str = ""

    @property
    def sources(self) -> tuple[Source, ...]:
        """Of the budget; none where there is none."""
        return () if self.found is None else self.found.sources

    @property
    def shares(self) -> Float[Array, "source n"]:
        """Of the mean square error of each coordinate."""
        return np.zeros((0, 0)) if self.found is None else self.found.share


def budgets(entries: Sequence[Entry], say: Callable[[str], None]) -> list[EntryBudget]:
    """The budget of each entry, by linear covariance analysis.

    Args:
        entries: of the report.
        say: called with a line before each.
    """
    return [_budget(entry, i, say) for i, entry in enumerate(entries)]


def _budget(entry: Entry, index: int, say: Callable[[str], None]) -> EntryBudget:
    say(f"error budget of {entry.key}")
    scenario = entry.source.scenario
    alone = {"estimators": {entry.label: scenario.estimators[entry.label]}}
    try:
        found = budget.of_setup(build(scenario.model_copy(update=alone)))
    except EstbenchError as error:
        return EntryBudget(entry.key, index, None, reason=str(error))
    (table,) = tables.build(found, range(len(found.names)))
    return EntryBudget(entry.key, index, found, table)
