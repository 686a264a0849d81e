"""What changes with time: noise that grows, gusts that come; from a table or a function.

A schedule gives factors on what the scenario says of a noise, or its whole covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np

from estbench import plugins as users
from estbench.errors import CovarianceError, ScenarioError, user_error_location
from estbench.shapes import Array
from estbench.spaces.linalg import is_positive_definite, is_positive_semidefinite

Value = float | Array
"""One factor, one an axis `(m,)`, or the whole covariance `(m, m)`."""
Symbol = Literal["R", "Q_s"]


class Schedule(Protocol):
    """A factor, or a covariance, over time."""

    def at(self, t: float) -> Value:
        """Its value at time t, s."""
        ...


@dataclass(frozen=True)
class PiecewiseConstant:
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
class UserFunction:
    """What a user's function of the time returns.

    Attributes:
        function: t in s -> a positive factor, one an axis `(axes,)`, or a whole `(axes, axes)`.
        axes: how many there are.
        where: the setting, for messages.
        symbol: of the covariance; R is positive definite, Q_s semidefinite.
    """

    function: Any
    axes: int
    where: str
    symbol: Symbol = "R"

    def at(self, t: float) -> Value:
        """Its value at time t, s.

        Raises:
            ScenarioError: the function raised, or returned neither factors nor a matrix of this
                size.
            CovarianceError: the matrix is no covariance.
        """
        try:
            value = np.asarray(self.function(t), dtype=np.float64)
        except Exception as error:  # a user's function may raise anything
            raise ScenarioError(
                f"{self.where} raised at t = {t:g} s: {user_error_location(error)}"
            ) from None
        if value.shape == (self.axes, self.axes):
            return self._covariance(value, t)
        if value.shape not in ((), (self.axes,)) or not ((value > 0) & (value < np.inf)).all():
            raise ScenarioError(
                f"{self.where} returned {value.tolist()} at t = {t:g} s; expected one positive "
                f"factor, {self.axes} of them, or {self.symbol} of shape {(self.axes, self.axes)}"
            )
        return value if value.ndim else float(value)

    def _covariance(self, value: Array, t: float) -> Array:
        definite = self.symbol == "R"
        if not (is_positive_definite if definite else is_positive_semidefinite)(value):
            raise CovarianceError(
                f"{self.where} returned {value.tolist()} at t = {t:g} s; {self.symbol} must be "
                f"symmetric positive {'definite' if definite else 'semidefinite'}"
            )
        return value


@dataclass(frozen=True)
class Scaled:
    """A schedule of whole covariances, each times a number; factors stay as they are."""

    schedule: Schedule
    scale: float

    def at(self, t: float) -> Value:
        """Its value at time t, s."""
        value = self.schedule.at(t)
        return self.scale * value if np.ndim(value) == 2 else value


def build(
    given: Sequence[tuple[float, float]] | str | None,
    axes: int,
    duration: float,
    where: str,
    symbol: Symbol = "R",
) -> Schedule | None:
    """From rows (until s, factor) or `module:function`; None, a constant 1, from None.

    Args:
        given: the setting.
        axes: of what is scaled, should a function return a factor an axis or a matrix.
        duration: of a run, s.
        where: the setting's name.
        symbol: of the covariance.

    Raises:
        ScenarioError: the times do not increase or end before the run; there is no such function,
            or it fails at t = 0.
        CovarianceError: it returns a matrix that is no covariance.
    """
    if given is None:
        return None
    if isinstance(given, str):
        schedule = UserFunction(users.function(given, where), axes, where, symbol)
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
    return PiecewiseConstant(until, tuple(row[1] for row in given))


def initial_covariance(schedule: Schedule | None) -> Array | None:
    """The covariance at t = 0 of a schedule of covariances; None of any other."""
    first = np.asarray(1.0 if schedule is None else schedule.at(0.0))
    return first if first.ndim == 2 else None


def unused(schedule: Schedule | None, section: Any, names: Sequence[str], where: str) -> list[str]:
    """A notice of constants that a section gives beside a schedule of whole covariances."""
    if initial_covariance(schedule) is None:
        return []
    given = [f"{where}.{name}" for name in names if getattr(section, name) is not None]
    return [f"{where}.schedule gives whole covariances: {name} is not used" for name in given]
