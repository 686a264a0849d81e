"""Sums over the instants that add up over windows of time, and the averages that they give."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.shapes import Array, Mask


@dataclass(frozen=True, eq=False)
class Total:
    """A sum.

    Attributes:
        value: of all instants so far.
    """

    value: NDArray[Any]

    def __add__(self, other: "Total") -> "Total":
        return Total(self.value + other.value)


@dataclass(frozen=True, eq=False)
class Mean:
    """A sum over the instants that count, and how many they are.

    Attributes:
        total: the sum.
        number: of instants.
    """

    total: Array
    number: Any

    def __add__(self, other: "Mean") -> "Mean":
        return Mean(self.total + other.total, self.number + other.number)

    @property
    def value(self) -> Array:
        """Their quotient; NaN where no instant counts."""
        out = np.full(np.shape(self.total), np.nan)
        number = np.broadcast_to(self.number, out.shape)
        return np.divide(self.total, number, out=out, where=number > 0)


@dataclass(frozen=True, eq=False)
class Ratio:
    """The quotient of two averages; NaN where both are 0.

    Attributes:
        above, below: the averages.
    """

    above: Mean
    below: Mean

    def __add__(self, other: "Ratio") -> "Ratio":
        return Ratio(self.above + other.above, self.below + other.below)

    @property
    def value(self) -> Array:
        """Their quotient."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.above.value / self.below.value


@dataclass(frozen=True, eq=False)
class Around:
    """Averages before an event, and from it on.

    Attributes:
        sides: both `(run, 2)`.
        happened: runs with an event `(run,)`.
    """

    sides: Mean
    happened: Mask

    def __add__(self, other: "Around") -> "Around":
        return Around(self.sides + other.sides, self.happened | other.happened)

    @property
    def value(self) -> Array:
        """The averages; NaN for a run without an event."""
        return np.where(self.happened[:, None], self.sides.value, np.nan)


Sum = Total | Mean | Ratio | Around
