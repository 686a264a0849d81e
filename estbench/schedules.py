"""Factors that change with time in steps: noise that grows, gusts that come."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import ScenarioError


@dataclass(frozen=True)
class Schedule:
    """A piecewise constant factor.

    Attributes:
        until: where each piece ends, s, increasing.
        factor: its factor.
    """

    until: tuple[float, ...]
    factor: tuple[float, ...]

    @classmethod
    def build(
        cls, rows: Sequence[tuple[float, float]] | None, duration: float, where: str
    ) -> "Schedule | None":
        """From rows (until s, factor), or None for a constant 1.

        Raises:
            ScenarioError: the times do not increase, or end before the run.
        """
        if rows is None:
            return None
        until = tuple(row[0] for row in rows)
        if any(b <= a for a, b in zip(until, until[1:])):
            raise ScenarioError(f"{where}: the times {until} do not increase")
        if until[-1] < duration - 1e-9:
            raise ScenarioError(
                f"{where} ends at {until[-1]:g} s but the run at {duration:g} s; "
                "extend its last row or shorten simulation.duration"
            )
        return cls(until, tuple(row[1] for row in rows))

    def at(self, t: float) -> float:
        """The factor at time t, s; a piece includes its end."""
        index = int(np.searchsorted(self.until, t - 1e-9))
        return self.factor[min(index, len(self.factor) - 1)]


def factor(schedule: Schedule | None, t: float) -> float:
    """The schedule's factor at t, 1 without a schedule."""
    return 1.0 if schedule is None else schedule.at(t)
