"""Noise that varies with time, from a table or a function.

A schedule gives factors on a noise of the scenario, or the full covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np

from estbench import plugins as users
from estbench.errors import CovarianceError, ScenarioError, user_error_location
from estbench.shapes import Array, Float
from estbench.spaces.linalg import is_positive_definite, is_positive_semidefinite

Value = float | Float[Array, " m"] | Float[Array, "m m"]
"""One factor, one per axis, or the full covariance."""
Symbol = Literal["R", "Q_s"]


class Schedule(Protocol):
    """A factor, or a covariance, over time."""

    def at(self, t: float) -> Value:
        """The factor or covariance at time t, s."""
        ...


@dataclass(frozen=True)
class PiecewiseConstant:
    """A piecewise constant factor.

    Attributes:
        until: end of each interval, s, increasing.
        factor: factor in each interval.
    """

    until: tuple[float, ...]
    factor: tuple[float, ...]

    def at(self, t: float) -> float:
        """The factor at time t, s; an interval includes its end."""
        index = int(np.searchsorted(self.until, t - 1e-9))
        return self.factor[min(index, len(self.factor) - 1)]


@dataclass(frozen=True)
class UserFunction:
    """A schedule from a user's function of time.

    Attributes:
        function: t in s -> a positive factor, one per axis `(axes,)`, or the full covariance
            `(axes, axes)`.
        axes: count of the axes.
        where: name of the setting, for messages.
        symbol: symbol of the covariance; R is positive definite, Q_s semidefinite.
    """

    function: Any
    axes: int
    where: str
    symbol: Symbol = "R"

    def at(self, t: float) -> Value:
        """The factor or covariance at time t, s.

        Raises:
            ScenarioError: the function raised, or returned neither factors nor a matrix
                `(axes, axes)`.
            CovarianceError: the matrix is not symmetric positive (semi)definite.
        """
        try:
            value = np.asarray(self.function(t), dtype=np.float64)
        except (Exception, SystemExit) as error:  # a user's function may raise anything
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

    def _covariance(self, value: Float[Array, "m m"], t: float) -> Float[Array, "m m"]:
        definite = self.symbol == "R"
        if not (is_positive_definite if definite else is_positive_semidefinite)(value):
            raise CovarianceError(
                f"{self.where} returned {value.tolist()} at t = {t:g} s; {self.symbol} must be "
                f"symmetric positive {'definite' if definite else 'semidefinite'}"
            )
        return value


@dataclass(frozen=True)
class Scaled:
    """A schedule whose full covariances are multiplied by `scale`; factors are unchanged."""

    schedule: Schedule
    scale: float

    def at(self, t: float) -> Value:
        """The factor or scaled covariance at time t, s."""
        value = self.schedule.at(t)
        return self.scale * value if np.ndim(value) == 2 else value


def build(
    given: Sequence[tuple[float, float]] | str | None,
    axes: int,
    duration: float,
    where: str,
    symbol: Symbol = "R",
) -> Schedule | None:
    """The schedule of rows (until s, factor) or of `module:function`; None from None.

    Args:
        given: the setting.
        axes: count of the axes of the noise.
        duration: length of each run, s.
        where: name of the setting, for messages.
        symbol: symbol of the covariance.

    Raises:
        ScenarioError: the times do not increase or end before the run; there is no such function,
            or it fails at t = 0.
        CovarianceError: the function returns a matrix that is not positive (semi)definite.
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


def initial_covariance(schedule: Schedule | None) -> Float[Array, "m m"] | None:
    """The covariance at t = 0 if the schedule gives covariances, else None."""
    first = np.asarray(1.0 if schedule is None else schedule.at(0.0))
    return first if first.ndim == 2 else None


def unused(schedule: Schedule | None, section: Any, names: Sequence[str], where: str) -> list[str]:
    """One notice per constant of a section that a schedule of full covariances overrides."""
    if initial_covariance(schedule) is None:
        return []
    given = [f"{where}.{name}" for name in names if getattr(section, name) is not None]
    return [f"{where}.schedule gives whole covariances: {name} is not used" for name in given]
