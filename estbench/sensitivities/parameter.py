"""A number of a scenario that is varied: where it stands, which factors of it are possible."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from estbench.study import keys
from estbench.study.axes import Range
from estbench.tables.quantity import number

Side = Literal["filter", "hardware"]
"""What the filter alone believes, so that it becomes wrong; what the robot has and the filter
knows, so that both change."""
Kind = Literal["smooth", "count", "rate", "latency", "timestep"]
"""Any factor; a whole number; a whole number of physics steps between readings, or from sampling
to arrival; a whole number of physics steps in, or of which one is, the step before."""
Changes = Mapping[keys.Names, Any]
"""Keys of a scenario with their values; none is the scenario itself."""


@dataclass(frozen=True)
class Parameter:
    """One number, or several that are multiplied by one factor.

    Attributes:
        key: its name for the user.
        names: where it stands in the scenario.
        side: whether the filter alone changes, or the robot too.
        value: as it is; a list or a matrix is multiplied as a whole.
        unit: of the value; empty where it has none, or several.
        kind: which factors are possible.
        step: of a latency the physics step, s; of a rate the physics rate, Hz; of a timestep the
            physics steps per control period.
        power: of the factor by which the value is multiplied: 2 for a covariance, whose factor is
            that of the standard deviation.
        frame_skip: whether `model.frame_skip` keeps the control period when a timestep changes.
        given: the range that the user gives, of values.
    """

    key: str
    names: keys.Names
    side: Side
    value: Any
    unit: str = ""
    kind: Kind = "smooth"
    step: float = 0.0
    power: int = 1
    frame_skip: bool = False
    given: Range | None = None

    def possible(self, factor: float) -> float:
        """The possible factor that is nearest to a factor, on a log scale at least."""
        if self.kind == "smooth":
            return factor
        if self.kind == "rate":  # step/rate physics steps between readings
            period = self.step / self.value
            return period / max(1, round(period / factor))
        if self.kind == "timestep":
            if factor < 1:
                return 1 / round(1 / factor)
            return float(round(factor))
        unit = 1.0 if self.kind == "count" else self.step
        return max(1, round(self.value * factor / unit)) * unit / self.value

    def neighbours(self, factor: float) -> tuple[float, float]:
        """The possible factors nearest to 1/factor and to factor, and different from 1 if any is.

        Args:
            factor: above 1.
        """
        low, high = self.possible(1 / factor), self.possible(factor)
        if low < 1 < high:
            return low, high
        if self.kind == "timestep":
            return 0.5, 2.0
        if self.kind == "rate":
            period = round(self.step / self.value)
            return period / (period + 1), period / max(1, period - 1)
        steps = round(self.value / (1.0 if self.kind == "count" else self.step))
        return max(1, steps - 1) / steps, (steps + 1) / steps

    def changes(self, factor: float) -> Changes:
        """The keys of the scenario that change, with their values."""
        value = np.asarray(self.value, np.float64) * factor**self.power
        if self.kind == "count":
            return {self.names: round(float(value))}
        out: dict[keys.Names, Any] = {self.names: value.tolist()}
        if self.frame_skip:
            out["model", "frame_skip"] = round(self.step / factor)
        return out

    def at(self, share: float) -> Changes:
        """The changes at a share of the way through the range that the user gives."""
        assert self.given is not None
        (value,) = self.given.at([share])
        return {self.names: round(value) if self.kind == "count" else value}

    @property
    def single(self) -> bool:
        """Whether it is one number."""
        return np.ndim(self.value) == 0

    def shown(self, factor: float = 1.0) -> str:
        """The value at a factor with its unit; of several numbers that differ, the factor."""
        values = np.asarray(self.value, np.float64).ravel()
        values = values[values != 0]
        if self.power == 1 and len(values) and (values == values[0]).all():
            return f"{number(float(values[0]) * factor)} {self.unit}".rstrip()
        return f"{number(factor)} x"
