"""A periodic control: cubic splines through knots, such as the joint angles of an open gait."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from estbench.errors import ControllerError, did_you_mean
from estbench.scenario.schema import ControlSection
from estbench.shapes import Array, Float
from estbench.spaces.patterns import expand

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

TIMES = 840
"""In one period, at which the bounds are found: a multiple of most counts of knots."""


@dataclass(frozen=True, eq=False)
class Periodic:
    """u(t) = u₀ + r(t) (s(t) - u₀) with the periodic splines s and the ramp r from 0 to 1.

    Up to `begin` the control is u₀. Then r = 3 a² - 2 a³ with a = (t - `begin`)/`ramp`, up to 1. On
    a position actuator with gains kp and kv the control is the target of a PD loop.

    Attributes:
        rest: u₀.
        driven: the controls that have knots; the others keep u₀.
        splines: of one period, in periods.
        phase: of each driven control, in periods: the spline is that much ahead.
        period: s.
        begin: s.
        ramp: s.
    """

    rest: Float[Array, " nu"]
    driven: Sequence[int]
    splines: Sequence["CubicSpline"]
    phase: Float[Array, " k"]
    period: float
    begin: float
    ramp: float

    @classmethod
    def build(
        cls, section: ControlSection, names: Sequence[str], rest: Float[Array, " nu"]
    ) -> "Periodic":
        """The control of a scenario.

        Args:
            section: `[control]`.
            names: of the controls.
            rest: u₀, the keyframe's control or zeros.

        Raises:
            ControllerError: `period` or `knots` is missing, or a pattern matches no control.
        """
        from scipy.interpolate import CubicSpline  # a third of the start of `estbench list`

        if section.period is None or not section.knots:
            missing = "knots" if section.period is not None else "period"
            raise ControllerError(
                f"control.{missing} is missing; periodic needs the period in s, and knots, "
                "{pattern: values over one period}"
            )
        knots = _knots(section.knots, names)
        splines = []
        for values in knots.values():
            closed = np.array([*values, values[0]])
            splines.append(CubicSpline(np.linspace(0, 1, len(closed)), closed, bc_type="periodic"))
        phase = expand(section.phase, names, "control.phase")[list(knots)]
        return cls(rest, list(knots), splines, phase, section.period, section.begin, section.ramp)

    def __call__(self, t: float) -> Float[Array, " nu"]:
        """The control at t, s."""
        since = max(t - self.begin, 0.0)
        share = 1.0 if since >= self.ramp else since / self.ramp
        if t < self.begin:
            return self.rest
        cycle = (since / self.period + self.phase) % 1.0
        target = np.array([float(spline(at)) for spline, at in zip(self.splines, cycle)])
        out = self.rest.copy()
        out[self.driven] += share**2 * (3.0 - 2.0 * share) * (target - out[self.driven])
        return out

    def bounds(self) -> tuple[Float[Array, " nu"], Float[Array, " nu"]]:
        """The least and the greatest control, of u₀ and of the splines at many times."""
        low, high = self.rest.copy(), self.rest.copy()
        for i, spline in zip(self.driven, self.splines):
            values = spline(np.linspace(0, 1, 1 + TIMES))
            low[i], high[i] = min(low[i], values.min()), max(high[i], values.max())
        return low, high


def _knots(given: Mapping[str, Sequence[float]], names: Sequence[str]) -> dict[int, list[float]]:
    """Index of each driven control -> its knots; of several patterns the last one applies."""
    found: dict[int, list[float]] = {}
    for pattern, values in given.items():
        hit = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
        if not hit:
            raise ControllerError(
                f"control.knots: '{pattern}' matches no control{did_you_mean(pattern, names)}"
            )
        found |= {i: list(values) for i in hit}
    return found
