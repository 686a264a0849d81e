"""What a sensitivity analysis found, as values and as a Dataset."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from estbench.consistency.intervals import Interval
from estbench.sensitivities.indices import Indices
from estbench.sensitivities.parameter import Parameter
from estbench.sensitivities.ranges import End
from estbench.shapes import Array, Float


@dataclass(frozen=True, eq=False)
class Slope:
    """Elasticities of one parameter.

    Attributes:
        parameter: which.
        factors: of its value, at which the runs were computed.
        rmse: d log RMSE / d log θ, RMSE the geometric mean over the coordinates.
        nees: d log NEES / d log θ.
        each: d log RMSE / d log θ of each coordinate.
        lost: runs that are left out, since they diverged.
    """

    parameter: Parameter
    factors: tuple[float, float]
    rmse: Interval
    nees: Interval
    each: tuple[Interval, ...]
    lost: int

    @property
    def largest(self) -> float:
        """The larger of the two elasticities, without its sign."""
        known = [abs(i.value) for i in (self.rmse, self.nees) if np.isfinite(i.value)]
        return max(known, default=0.0)


@dataclass(frozen=True, eq=False)
class Curve:
    """One parameter over a wide range.

    Attributes:
        parameter: which.
        factors: of its value.
        rmse: over that of the scenario as it is; NaN where it cannot be run.
        nees: NEES/n.
        diverged: share of the runs.
    """

    parameter: Parameter
    factors: Float[Array, " k"]
    rmse: Float[Array, " k"]
    nees: Float[Array, " k"]
    diverged: Float[Array, " k"]


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """The sensitivity of one estimator.

    Attributes:
        scenario: its name.
        estimator: the label.
        names, units: of the coordinates.
        runs: of each variant.
        level: of the intervals.
        step: relative change of the parameters.
        slopes: the largest first.
        curves: of some parameters.
        ranges: parameter and ends, where they were asked for.
        indices: where they were asked for.
        notices: what was left out, and why.
    """

    scenario: str
    estimator: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    runs: int
    level: float
    step: float
    slopes: tuple[Slope, ...]
    curves: tuple[Curve, ...] = ()
    ranges: tuple[tuple[Parameter, End, End], ...] = ()
    indices: Indices | None = None
    notices: tuple[str, ...] = ()

    def dataset(self) -> xr.Dataset:
        """The numbers with the dimensions `parameter`, `coordinate`, `factor` and `indexed`.

        `rmse` and `nees` are elasticities, `coordinate_rmse` those of each coordinate, each with
        `_low` and `_high`; `curve_rmse` and `curve_nees` belong to the parameters `curve`;
        `range_low` and `range_high` are factors of the values of the parameters `ranged`;
        `first_order` and `total` are indices of the outputs `RMSE` and `NEES/n`.
        """
        found: dict[str, Any] = {}
        for i, suffix in enumerate(("", "_low", "_high")):
            for name in ("rmse", "nees"):
                found[name + suffix] = ("parameter", [_ends(getattr(s, name))[i]
                                                      for s in self.slopes])  # fmt: skip
            found[f"coordinate_rmse{suffix}"] = (
                ("parameter", "coordinate"), [[_ends(e)[i] for e in s.each] for s in self.slopes]
            )  # fmt: skip
        coords: dict[str, Any] = {
            "parameter": [s.parameter.key for s in self.slopes],
            "side": ("parameter", [s.parameter.side for s in self.slopes]),
            "coordinate": list(self.names), "unit": ("coordinate", list(self.units)),
        }  # fmt: skip
        if self.curves:
            coords["curve"] = [c.parameter.key for c in self.curves]
            for name in ("factors", "rmse", "nees", "diverged"):
                values = np.stack([getattr(c, name) for c in self.curves])
                found[f"curve_{name}"] = (("curve", "factor"), values)
        if self.ranges:
            coords["ranged"] = [p.key for p, _, _ in self.ranges]
            found["range_low"] = ("ranged", [low.factor for _, low, _ in self.ranges])
            found["range_high"] = ("ranged", [high.factor for _, _, high in self.ranges])
            found["range_confirmed"] = ("ranged", [low.confirmed and high.confirmed
                                                   for _, low, high in self.ranges])  # fmt: skip
        if self.indices is not None:
            coords["indexed"] = [p.key for p in self.indices.parameters]
            coords["output"] = ["RMSE", "NEES/n"]
            for name, values in (
                ("first_order", self.indices.first),
                ("total", self.indices.total),
            ):
                for i, suffix in enumerate(("", "_low", "_high")):
                    found[name + suffix] = (("output", "indexed"), values[..., i])
        attrs = {"scenario": self.scenario, "estimator": self.estimator, "runs": self.runs,
                 "step": self.step, "notices": list(self.notices)}  # fmt: skip
        return xr.Dataset(found, coords, attrs)


def _ends(i: Interval) -> tuple[float, float, float]:
    return i.value, i.low, i.high
