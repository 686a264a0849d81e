"""Factors that change with time: noise that grows, gusts that come; from a table or a function."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from estbench import users
from estbench.errors import ScenarioError

Array = NDArray[np.float64]
Factor = float | Array
"""One factor, or one an axis."""


class Schedule(Protocol):
    """A factor over time."""

    def at(self, t: float) -> Factor:
        """The factor at time t, s."""
        ...


@dataclass(frozen=True)
class Table:
    """A piecewise constant factor.

    Attributes:
        until: where each piece ends, s, increasing.
        factor: its factor.
    """

    until: tuple[float, ...]
    factor: tuple[float, ...]

    def at(self, t: float) -> float:
        """The factor at time t, s; a piece includes its end."""
        index = int(np.searchsorted(self.until, t - 1e-9))
        return self.factor[min(index, len(self.factor) - 1)]


@dataclass(frozen=True)
class User:
    """The factor that a user's function of the time returns.

    Attributes:
        function: t in s -> a positive number, or one an axis `(axes,)`.
        axes: how many there are.
        where: the setting, for messages.
    """

    function: Any
    axes: int
    where: str

    def at(self, t: float) -> Factor:
        """The factor at time t, s.

        Raises:
            ScenarioError: the function raised, or returned no positive factor.
        """
        try:
            value = np.asarray(self.function(t), dtype=np.float64)
        except Exception as error:  # a user's function may raise anything
            raise ScenarioError(
                f"{self.where} raised at t = {t:g} s: {type(error).__name__}: {error}"
            ) from None
        if value.shape not in ((), (self.axes,)) or not ((value > 0) & (value < np.inf)).all():
            raise ScenarioError(
                f"{self.where} returned {value.tolist()} at t = {t:g} s; expected one positive "
                f"factor, or {self.axes}"
            )
        return value if value.ndim else float(value)


def build(
    given: Sequence[tuple[float, float]] | str | None, axes: int, duration: float, where: str
) -> Schedule | None:
    """From rows (until s, factor) or `module:function`; None, a constant 1, from None.

    Args:
        given: the setting.
        axes: of what is scaled, should a function return a factor an axis.
        duration: of a run, s.
        where: the setting's name.

    Raises:
        ScenarioError: the times do not increase or end before the run; there is no such function.
    """
    if given is None:
        return None
    if isinstance(given, str):
        schedule = User(users.function(given, where), axes, where)
        schedule.at(0.0)
        return schedule
    until = tuple(row[0] for row in given)
    if any(b <= a for a, b in pairwise(until)):
        raise ScenarioError(f"{where}: the times {until} do not increase")
    if until[-1] < duration - 1e-9:
        raise ScenarioError(
            f"{where} ends at {until[-1]:g} s but the run at {duration:g} s; "
            "extend its last row or shorten simulation.duration"
        )
    return Table(until, tuple(row[1] for row in given))


def factor(schedule: Schedule | None, t: float) -> Factor:
    """The schedule's factor at t, 1 without a schedule."""
    return 1.0 if schedule is None else schedule.at(t)
