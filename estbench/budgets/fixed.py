"""What a wrong model adds to the errors of each step: differences of models at the true states."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.budgets.sources import Source, different
from estbench.experiment.prepared import Setup
from estbench.models.protocol import Channels
from estbench.robots import parameters
from estbench.robots.model import MujocoModel
from estbench.shapes import Array, Float


@dataclass(frozen=True, eq=False)
class Difference:
    """A difference of two models: (model - other)/scale; None stands for the filter's model."""

    model: MujocoModel
    other: MujocoModel | None
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class WrongModel:
    """What the filter's model leaves out, one column per source.

    A parameter with another value in the truth: f with that value alone corrected, minus f of the
    filter; the whole change, not a derivative. One that is drawn in each run: the change by one
    standard deviation, from both sides. `rest`: what the corrected parameters do not explain.

    Attributes:
        plain: the filter's model.
        truth: the true model.
        parts: of the sources of kind `parameter` and `draw`, in order.
        rest: whether the filter's model has another structure, or several parameters differ.
    """

    plain: MujocoModel
    truth: MujocoModel
    parts: tuple[Difference, ...]
    rest: bool

    @classmethod
    def of(
        cls, setup: Setup, label: str, truth: MujocoModel, found: Sequence[Source]
    ) -> "WrongModel":
        """That of an estimator, for the sources of its budget."""
        side, true = setup.believed[label], setup.plant.model

        def model(key: str, value: Array) -> MujocoModel:
            robot = parameters.changed(side.robot, {key: value.tolist()}, "budget")
            return setup.model(robot=robot, believed=side)

        parts = []
        for source in found:
            key = source.target
            if source.kind == "parameter":
                field, index = parameters.parameter(true, key, "budget")
                value = np.asarray(getattr(true, field)[index], np.float64)
                parts.append(Difference(model(key, value), None))
            elif source.kind == "draw":
                draw = setup.scenario.truth.draw[key]
                spread, ends = (draw.relative_std, draw.std), np.array([[1.0], [-1.0]])
                *_, (high, low) = parameters.of_normals(true, key, spread, ends)
                both = (model(key, np.asarray(value)) for value in (high, low))
                parts.append(Difference(*both, 2.0))
        rest = any(s.kind == "model" for s in found) or len(different(setup, label)) > 1
        return cls(setup.model(believed=side), truth, tuple(parts), rest)

    @property
    def width(self) -> int:
        """Count of columns."""
        return len(self.parts) + self.rest

    def of_transition(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "run n c"]:
        """D, of the state at the end."""
        ends = {id(m): m.transition(x, u, t, dt) for m in self._models}
        return self._columns(ends, self.plain.space.minus)

    def of_measurement(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, channels: Channels
    ) -> Float[Array, "run m c"]:
        """S, of the readings; 0 where one has no return."""
        read = {id(m): m.measurement(x, u, t, channels) for m in self._models}
        out = self._columns(read, self.plain.output(channels).minus)
        return np.where(np.isfinite(out), out, 0.0)

    @property
    def _models(self) -> tuple[MujocoModel, ...]:
        others = [m for part in self.parts for m in (part.model, part.other) if m is not None]
        return (self.plain, *others, *((self.truth,) if self.rest else ()))

    def _columns(self, values: dict[int, Array], minus) -> Array:
        plain, columns = values[id(self.plain)], []
        for part in self.parts:
            other = plain if part.other is None else values[id(part.other)]
            columns.append(minus(values[id(part.model)], other) / part.scale)
        if self.rest:
            known = [c for c, part in zip(columns, self.parts) if part.other is None]
            columns.append(minus(values[id(self.truth)], plain) - sum(known))
        return np.stack(columns, axis=-1)
