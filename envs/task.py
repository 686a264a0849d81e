"""The task of a policy: reward, end and horizon from the scenario's `[task]`."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estbench.errors import CovarianceError
from estbench.robots.controls import ControlRange
from estbench.robots.layout import control_names
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.simulation.controllers import Plant
from estbench.spaces.patterns import expand


@dataclass(frozen=True, eq=False)
class Task:
    """reward = alive - Σ wᵢ eᵢ² - Σ rⱼ ũⱼ², with e = x ⊖ goal and ũ = u - u₀, once per step.

    Attributes:
        plant: the nominal robot, with keyframe x₀, u₀.
        goal: `(nx,)`.
        state_weight: w `(n,)`, 1/unit².
        control_weight: r `(nu,)`, 1/unit².
        alive: reward of a step that stays within the bounds.
        bounds: largest |eᵢ| `(n,)`, inf where there is none.
        steps: the horizon in steps of the environment.
        limits: range of the controls.
    """

    plant: Plant
    goal: Array
    state_weight: Array
    control_weight: Array
    alive: float
    bounds: Array
    steps: int
    limits: ControlRange

    @classmethod
    def build(cls, scenario: Scenario, plant: Plant) -> "Task":
        """From a scenario.

        Raises:
            ScenarioError: a pattern of `[task]` matches no coordinate.
            DimensionError: a list of another length.
            CovarianceError: a weight is negative.
        """
        section, names = scenario.task, plant.space.names
        target = expand(section.target, names, "task.target")
        weights = {
            "state_weight": expand(section.state_weight, names, "task.state_weight"),
            "control_weight": expand(
                section.control_weight, control_names(plant.model), "task.control_weight"
            ),
        }
        for name, weight in weights.items():
            if weight.size and weight.min() < 0:
                raise CovarianceError(
                    f"task.{name} is {weight.min():g}; a cost needs weights of at least 0"
                )
        horizon = section.horizon or scenario.simulation.duration
        return cls(
            plant=plant,
            goal=plant.space.plus(plant.x0, target),
            alive=section.alive,
            bounds=expand(section.bounds, names, "task.bounds", np.inf),
            steps=max(1, round(horizon / plant.period)),
            limits=ControlRange.of(plant.model),
            **weights,
        )

    def cost(self, x: Array, u: Array) -> Array:
        """Σ wᵢ eᵢ² + Σ rⱼ ũⱼ² `(row,)` of states `(row, nx)` and applied controls `(row, nu)`."""
        return self._cost(self.plant.space.minus(x, self.goal), u)

    def outside(self, x: Array) -> NDArray[np.bool_]:
        """Rows whose state is out of bounds or not finite `(row,)`."""
        return self._outside(self.plant.space.minus(x, self.goal))

    def reward(self, x: Array, u: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Reward and whether the episode ends there `(row,)`.

        A state that MuJoCo could not compute costs nothing and earns nothing.
        """
        e = self.plant.space.minus(x, self.goal)
        out, cost = self._outside(e), self._cost(e, u)
        if not np.count_nonzero(out):  # as usual: half the time
            return self.alive - cost, out
        return np.nan_to_num(np.where(out, 0.0, self.alive) - cost), out

    @cached_property
    def _free(self) -> bool:
        """Whether controls cost nothing, as by default."""
        return not self.control_weight.any()

    def _cost(self, e: Array, u: Array) -> Array:
        cost = np.vecdot(self.state_weight * e, e)
        if not self._free:
            effort = self.limits.clamp(u) - self.plant.u0
            cost = cost + np.vecdot(self.control_weight * effort, effort)
        return cost

    def _outside(self, e: Array) -> NDArray[np.bool_]:
        inside = np.abs(e) <= self.bounds
        if np.count_nonzero(inside) == inside.size:  # a third of `all(axis=-1)`'s time
            return np.zeros(len(e), bool)
        return np.logical_not(inside.all(axis=-1))
