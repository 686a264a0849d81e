"""What is free in a tuning: its range, its scale, its prior, and its coordinate in the search."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from estbench.errors import StudyError
from estbench.shapes import Array, Float
from estbench.study import axes, keys

Kind = Literal["smooth", "stepped", "whole", "choice"]
"""A number on which the objective depends smoothly; one that is rounded (a latency in physics
steps); a whole number; one of several values."""


@dataclass(frozen=True)
class Prior:
    """What is known of a value beforehand: log-normal on a log scale, else normal.

    Attributes:
        centre: median.
        spread: standard deviation as a factor on a log scale (2: within a factor of 2 with
            probability 68%), else in the value's unit.
    """

    centre: float
    spread: float


@dataclass(frozen=True)
class Parameter:
    """One free parameter.

    Attributes:
        names: where it stands in the scenario.
        key: its name for the user.
        start: the value before the tuning.
        low, high: its range.
        log: whether the search sees its logarithm.
        kind: how the objective depends on it.
        choices: the values of a choice.
        prior: for a maximum a posteriori estimate.
    """

    names: keys.Names
    key: str
    start: Any
    low: float = 0.0
    high: float = 1.0
    log: bool = False
    kind: Kind = "smooth"
    choices: tuple[Any, ...] = ()
    prior: Prior | None = None

    def coordinate(self, value: Any) -> float:
        """The coordinate: log value, share of the way from low to high, or number of a choice."""
        if self.kind == "choice":
            return float(self.choices.index(value)) if value in self.choices else 0.0
        return float(np.log(value) if self.log else (value - self.low) / (self.high - self.low))

    def value(self, coordinate: float) -> Any:
        """The value at a coordinate; the ends of the range are met exactly."""
        if self.kind == "choice":
            return self.choices[round(coordinate)]
        first, last = self.bounds
        if coordinate <= first:
            found = self.low
        elif coordinate >= last:
            found = self.high
        elif self.log:
            found = float(np.exp(coordinate))
        else:
            found = self.low + (self.high - self.low) * float(coordinate)
        return round(found) if self.kind == "whole" else found

    @property
    def bounds(self) -> tuple[float, float]:
        """The range of the coordinate."""
        if self.kind == "choice":
            return 0.0, len(self.choices) - 1.0
        return self.coordinate(self.low), self.coordinate(self.high)

    def penalty(self, coordinate: Float[Array, " k"]) -> Float[Array, " k"]:
        """Minus the log density of the prior, up to a constant; 0 without one."""
        if self.prior is None or self.kind == "choice":
            return np.zeros(len(coordinate))
        if self.log:
            z = (coordinate - np.log(self.prior.centre)) / np.log(self.prior.spread)
        else:
            value = self.low + (self.high - self.low) * coordinate
            z = (value - self.prior.centre) / self.prior.spread
        return 0.5 * z**2


@dataclass(frozen=True)
class Free:
    """What the user says of a free parameter.

    Attributes:
        key: of the scenario, or of the estimator's settings.
        low, high: the range; None for the default.
        choices: values to choose from.
    """

    key: str
    low: float | None = None
    high: float | None = None
    choices: tuple[Any, ...] = ()


def parse(text: str) -> Free:
    """`KEY`, `KEY=LOW:HIGH` or `KEY=A,B,C`.

    Raises:
        StudyError: it has another form, or the range is empty.
    """
    key, equals, spec = text.partition("=")
    if not equals:
        return Free(key.strip())
    if ":" not in spec or "," in spec:
        _, values = axes.parse(text)
        assert isinstance(values, tuple)
        if len(values) < 2:
            raise StudyError(f"--free {text!r} leaves no choice; use KEY=LOW:HIGH or KEY=A,B")
        return Free(key.strip(), choices=values)
    low, _, high = spec.partition(":")
    try:
        ends = float(low), float(high)
    except ValueError:
        raise StudyError(f"--free {text!r}: {spec} is no range; use KEY=LOW:HIGH") from None
    if not (np.isfinite(ends).all() and ends[0] < ends[1]):
        raise StudyError(f"--free {text!r}: the range is empty; give LOW < HIGH")
    return Free(key.strip(), *ends)


def parse_prior(text: str) -> tuple[str, Prior]:
    """`KEY=CENTRE:SPREAD`.

    Raises:
        StudyError: it has another form.
    """
    key, _, spec = text.partition("=")
    centre, _, spread = spec.partition(":")
    try:
        return key.strip(), Prior(float(centre), float(spread))
    except ValueError:
        raise StudyError(f"--prior {text!r} is not of the form KEY=CENTRE:SPREAD") from None


def with_priors(
    parameters: Sequence[Parameter], priors: Sequence[tuple[str, Prior]]
) -> tuple[Parameter, ...]:
    """The parameters with their priors.

    Raises:
        StudyError: a prior is of no free parameter, or impossible.
    """
    known = {p.key: p for p in parameters}
    for key, prior in priors:
        if key not in known:
            raise StudyError(
                f"prior of '{key}': it is not free; the free parameters are {', '.join(known)}"
            )
        least = 1.0 if known[key].log else 0.0
        if not (prior.spread > least and np.isfinite(prior.centre)):
            what = "a factor above 1" if known[key].log else "a standard deviation above 0"
            raise StudyError(f"prior of '{key}': the spread is {prior.spread:g}; use {what}")
        if known[key].log and prior.centre <= 0:
            raise StudyError(f"prior of '{key}': the centre is {prior.centre:g}; use one above 0")
        known[key] = replace(known[key], prior=prior)
    return tuple(known.values())


def values_at(
    parameters: Sequence[Parameter], points: Float[Array, "k p"]
) -> list[tuple[Any, ...]]:
    """The values at some points of the search."""
    return [tuple(p.value(x) for p, x in zip(parameters, point)) for point in points.tolist()]
