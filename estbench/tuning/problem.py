"""The loss over the coordinates of the search, with slopes from one set of candidates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estbench.shapes import Array, Float
from estbench.tuning.evaluation import Evaluate, Evaluation
from estbench.tuning.objective import Objective
from estbench.tuning.parameters import Parameter, values_at

STEP = 1e-3
"""Half the distance of the two candidates of a slope, in the coordinate of the search."""


@dataclass(frozen=True)
class Step:
    """One point of the search's trace.

    Attributes:
        values: of the free parameters.
        loss: there.
        candidates: how many were computed up to here.
    """

    values: tuple[Any, ...]
    loss: float
    candidates: int


@dataclass(eq=False)
class Problem:
    """A loss to be minimized over a box.

    Attributes:
        parameters: the free parameters.
        evaluate: computes candidates.
        objective: the loss of each run.
        note: called with every set of candidates and the best loss so far.
        trace: the points at which the loss was asked for, in order.
        best: the point with the least loss that satisfies the constraint, and its loss.
        count: of candidates that were asked for.
    """

    parameters: Sequence[Parameter]
    evaluate: Evaluate
    objective: Objective
    note: Callable[[int, float], None] = lambda count, loss: None
    trace: list[Step] = field(default_factory=list)
    best: tuple[Array | None, float] = (None, np.inf)
    count: int = 0

    @property
    def bounds(self) -> Float[Array, "p 2"]:
        """Lowest and highest coordinates."""
        return np.array([p.bounds for p in self.parameters])

    @property
    def start(self) -> Float[Array, " p"]:
        """The coordinates before the tuning."""
        return np.array([p.coordinate(p.start) for p in self.parameters])

    def at(self, points: Float[Array, "k p"]) -> tuple[Evaluation, Float[Array, " k"]]:
        """What some points give, computed as one set, and the mean loss of each with its prior."""
        low, high = self.bounds.T
        points = np.clip(points, low, high)
        found = self.evaluate(values_at(self.parameters, points))
        self.count += len(points)
        loss = self.objective.losses(found).mean(axis=1) + self.prior(points)
        allowed = np.array([not reason for reason in found.reasons])
        if self.objective.constrained:
            allowed &= (self.objective.slack(found) >= -1e-9).all(axis=1)
        for point, value, good in zip(points, loss, allowed):
            if good and value < self.best[1]:
                self.best = point.copy(), float(value)
        self.note(self.count, self.best[1])
        return found, loss

    def prior(self, points: Float[Array, "k p"]) -> Float[Array, " k"]:
        """Minus the log density of the priors, per run."""
        total = sum(p.penalty(column) for p, column in zip(self.parameters, points.T))
        return np.asarray(total, dtype=np.float64) / self.evaluate.runs

    def visited(self, point: Float[Array, " p"], loss: float) -> None:
        """Note a point of the trace."""
        (values,) = values_at(self.parameters, point[None])
        self.trace.append(Step(values, loss, self.count))

    def slopes(
        self, point: Float[Array, " p"], step: float = STEP
    ) -> tuple[Evaluation, Float[Array, " k"], Float[Array, " p"], Float[Array, "p k"]]:
        """The point and two neighbours along each coordinate, computed as one set.

        Returns:
            Their evaluation (the point first, then those below, then those above), the losses, the
            distances of the neighbours, and the differences (above - below)/distance of the loss
            of each run.
        """
        points, width = neighbours(point, self.bounds, step)
        found, loss = self.at(points)
        p = len(point)
        losses = self.objective.losses(found)
        scores = (losses[1 + p :] - losses[1 : 1 + p]) / width[:, None]
        return found, loss, width, scores


def neighbours(
    point: Float[Array, " p"], bounds: Float[Array, "p 2"], step: float
) -> tuple[Float[Array, "k p"], Float[Array, " p"]]:
    """The point, then those below and those above along each coordinate, within the bounds."""
    low, high = bounds.T
    below = np.clip(point - step * np.eye(len(point)), low, high)
    above = np.clip(point + step * np.eye(len(point)), low, high)
    width = np.diagonal(above) - np.diagonal(below)
    return np.concatenate([point[None], below, above]), width
