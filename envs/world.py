"""Truth, task, sensors and filters of many robots: the core of the native environments."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.envs.errors import EnvError
from estbench.envs.filter import FilterBank
from estbench.envs.keys import Keys, Mask
from estbench.envs.observer import Observer
from estbench.envs.readings import Readings
from estbench.envs.task import Task
from estbench.envs.truth import TruthRows
from estbench.estimators import registry
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.robots.controls import ControlRange
from estbench.scenario import load as scenarios
from estbench.shapes import Array

Estimator = str | Mapping[str, Any] | None
"""A scenario's label, a name, `package.module:Name`, a table of settings with `type`, or none."""


def prepare(
    scenario: str | Path | scenarios.Scenario | None,
    estimator: Estimator,
    sensors: Sequence[str] | None,
    overrides: Sequence[str],
) -> setup.Setup:
    """The resolved scenario with one estimator (any, if none is asked for).

    Raises:
        EstbenchError: whatever does not fit.
    """
    if scenario is None:
        raise EnvError(
            "scenario is missing; name one, as in gym.make('estbench/Scenario-v0', "
            "scenario='my_robot.toml')"
        )
    loaded = (
        scenarios.override(scenario, overrides)
        if isinstance(scenario, scenarios.Scenario)
        else scenarios.load(scenario, overrides)
    )
    if sensors is not None:
        loaded = loaded.model_copy(update={"sensors": list(sensors)})
    if isinstance(estimator, Mapping):
        if "type" not in estimator:
            raise EnvError(
                f"estimator is {dict(estimator)}; a table needs a type, e.g. "
                "{'type': 'ukf', 'alpha': 0.5}"
            )
        loaded = loaded.model_copy(update={"estimators": {"policy": dict(estimator)}})
    elif estimator is not None:
        loaded = experiment.resolve(loaded, [estimator])
    return setup.build(loaded)


class World:
    """`rows` robots of one scenario under a task, observed.

    Args:
        prepared: the resolved scenario; its first estimator is used.
        rows: how many robots.
        filtered: whether there is a filter at all.
        nthread: threads of the batches.
        look: whether raw readings are wanted from the start of an episode on.

    Attributes:
        observer: sensors and filters.
        task: reward, end, horizon.
        truth: the true robots.
        u: controls held in the last step `(row, nu)`.
    """

    def __init__(
        self,
        prepared: setup.Setup,
        rows: int,
        filtered: bool = True,
        nthread: int = 1,
        look: bool = False,
    ):
        self.setup, self.rows = prepared, rows
        scenario, plant = prepared.scenario, prepared.plant
        self.task = Task.build(scenario, plant)
        self.truth = TruthRows(prepared, rows, nthread)
        readings = Readings(plant.model, prepared.channels, rows, nthread, look=look)
        self._stride = readings.stride(plant.nstep)
        bank, mean, cov = None, prepared.mean, prepared.cov
        if filtered:
            label = next(iter(scenario.estimators))
            if prepared.start(label).method != "prior":
                raise EnvError(
                    f"{label}: start.method is '{prepared.start(label).method}'; in an environment "
                    "a filter starts from the prior, so leave it out"
                )
            made = registry.create(label, prepared.settings(label), prepared.model(nthread))
            exact = prepared.delays(label).handling == "exact"
            depth = readings.depth(self._stride) if exact else 0
            threshold = scenario.consistency.divergence_threshold
            bank = FilterBank(made, prepared.space, readings.slots, rows, threshold, depth)
            mean, cov = prepared.prior(label)
        self.observer = Observer(plant.model, readings, bank)
        mean, cov = prepared.prior(next(iter(scenario.estimators)))
        self._prior = np.repeat(mean[None], rows, axis=0), np.repeat(cov[None], rows, axis=0)
        self.u = np.repeat(plant.u0[None], rows, axis=0)

    @property
    def elapsed(self) -> NDArray[np.int64]:
        """Steps of the environment since the reset `(row,)`."""
        return self.truth.tick // self.setup.plant.nstep

    def limit(self, steps: int) -> None:
        """Another horizon, in steps of the environment.

        Raises:
            EnvError: it is not positive.
        """
        if steps < 1:
            raise EnvError(f"max_episode_steps is {steps}; use at least 1")
        self.task = replace(self.task, steps=int(steps))

    def reset(self, mask: Mask, keys: Keys) -> None:
        """Start the rows of a mask anew, with random keys `(mask.sum(),)`."""
        self.truth.reset(mask, keys)
        self.u[mask] = self.setup.plant.u0
        self.observer.reset(mask, keys, self.truth.x, self.u, *self._prior)

    def step(self, u: Array, mask: Mask | None = None) -> tuple[Array, Mask, Mask]:
        """One control period under controls `(row, nu)`.

        Args:
            u: controls, in the actuators' units; clamped to their range.
            mask: rows that take part; None is all.

        Returns:
            Reward, terminated and truncated `(row,)`; 0 and False outside the mask.
        """
        u = ControlRange.of(self.setup.plant.model).clamp(u)
        self.u = u if mask is None else np.where(mask[:, None], u, self.u)
        self.observer.begin()
        for _ in range(self.setup.plant.nstep // self._stride):
            x = self.truth.step(self.u, self._stride, mask)
            self.observer.advance(self._stride, x, self.u, mask)
        reward, ended = self.task.reward(self.truth.x, self.u)
        late = ~ended & (self.elapsed >= self.task.steps)
        if mask is not None:
            reward, ended, late = np.where(mask, reward, 0.0), ended & mask, late & mask
        return reward, ended, late
