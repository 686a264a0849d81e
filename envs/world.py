"""Robots of a scenario, a task and a filter, step by step: the core of the native environments."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estbench.envs.errors import EnvError, check_threads
from estbench.envs.features import Features
from estbench.envs.task import Task
from estbench.experiment import setup
from estbench.inference.live import LiveFilter
from estbench.montecarlo import run as experiment
from estbench.randomness import streams
from estbench.randomness.streams import Seeds
from estbench.scenario import load as scenarios
from estbench.scenario.schema import Scenario
from estbench.shapes import Array, Ints, Mask
from estbench.spaces.linalg import quiet

Estimator = str | Mapping[str, Any] | None
"""A scenario's label, a name, `package.module:Name`, a table of settings with `type`, or none."""


def prepare(
    scenario: str | Path | Scenario | None,
    estimator: Estimator,
    sensors: Sequence[str] | None,
    overrides: Sequence[str],
) -> setup.Setup:
    """The resolved scenario with one estimator (any, if none is asked for).

    Raises:
        EstbenchError: the scenario or a setting is wrong.
    """
    if scenario is None:
        raise EnvError(
            "scenario is missing; name one, as in gym.make('estbench/Scenario-v0', "
            "scenario='my_robot.toml')"
        )
    loaded = (
        scenarios.override(scenario, overrides)
        if isinstance(scenario, Scenario)
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
    """`rows` robots of one scenario under a task, and their filter.

    Args:
        prepared: the resolved scenario; its first estimator is used.
        rows: how many robots.
        filtered: whether there is a filter at all.
        nthread: threads of the physics; None for as many as make it faster.
        look: whether raw readings are wanted from the start of an episode on.

    Attributes:
        task: reward, end, horizon.
        simulator: the true robots and their sensors.
        filter: their beliefs, or None.
        u: controls held in the last step `(row, nu)`.
    """

    def __init__(
        self,
        prepared: setup.Setup,
        rows: int,
        filtered: bool = True,
        nthread: int | None = 1,
        look: bool = False,
    ):
        check_threads(nthread)
        self.setup, self.rows = prepared, rows
        scenario, plant = prepared.scenario, prepared.plant
        self.task = Task.build(scenario, plant)
        self._label = next(iter(scenario.estimators))
        timed = self._timed = filtered and prepared.depends_on_time(self._label)
        self.simulator = prepared.robots(rows, nthread=nthread, look=look, timed=timed)
        self.filter: LiveFilter | None = None
        if filtered:
            self.filter = LiveFilter(
                prepared.estimator(self._label, nthread),
                prepared.space,
                prepared.channel_spaces,
                rows,
                prepared.delays(self._label),
                scenario.consistency.divergence_threshold,
                timed,
            )
        mean, cov = prepared.prior(self._label)
        self._prior = np.repeat(mean[None], rows, axis=0), np.repeat(cov[None], rows, axis=0)
        self.u = np.repeat(plant.u0[None], rows, axis=0)

    @property
    def x(self) -> Array:
        """True states `(row, nx)`."""
        return self.simulator.x

    def belief(self, row: int) -> tuple[Array, Array] | None:
        """x̂ `(nx,)` and P `(n, n)` of one row, or None without a filter."""
        return None if self.filter is None else (self.filter.estimate[row], self.filter.cov[row])

    def features(self, observe: str) -> Features:
        """The observation of a kind."""
        return Features(observe, self.simulator.suite, self.filter, self.setup.space.nx)

    @property
    def elapsed(self) -> Ints:
        """Steps of the environment since the reset `(row,)`."""
        return self.simulator.clocks.elapsed // self.setup.plant.nstep

    def limit(self, steps: int) -> None:
        """Set another horizon, in steps of the environment.

        Raises:
            EnvError: it is not positive.
        """
        if steps < 1:
            raise EnvError(f"max_episode_steps is {steps}; use at least 1")
        self.task = replace(self.task, steps=int(steps))

    def reset(self, rows: Ints, seed: Seeds, runs: Sequence[int]) -> None:
        """Begin episodes in some rows.

        Args:
            rows: their numbers.
            seed: of all of them, or one for each.
            runs: the number of the run in each.
        """
        self.u[rows] = self.setup.plant.u0
        self.simulator.start(rows, seed, runs, self.u)
        if self.filter is not None:
            keys = None
            if self.filter.random:
                keys = np.zeros(self.rows, np.uint64)
                keys[rows] = streams.run_keys(seed, runs, f"estimator:{self._label}")
            self.filter.start(rows, *self._prior, keys)

    def step(self, u: Array, mask: Mask | None = None) -> tuple[Array, Mask, Mask]:
        """One control period under controls `(row, nu)`.

        Args:
            u: controls, in the actuators' units; truth and filter clamp them to their range.
            mask: rows that take part; None is all. The others must begin anew before they take
                part again. Unless the time matters they are stepped too and nobody looks: a
                mask would cost more than they do.

        Returns:
            Reward, terminated and truncated `(row,)`; 0 and False outside the mask.
        """
        self.u = u if mask is None else np.where(mask[:, None], u, self.u)
        if self.filter is not None:
            self.filter.begin()
        with quiet():
            for event in self.simulator.clocks.period(mask if self._timed else None):
                arrived = self.simulator.advance(event, self.u)
                if self.filter is not None:
                    self.filter.step(event, self.u, arrived)
            if self.filter is not None:
                self.filter.settle()
        x = self.simulator.x
        reward, ended = self.task.reward(x, self.u)
        late = ~ended & (self.elapsed >= self.task.steps)
        if mask is not None:
            reward, ended, late = np.where(mask, reward, 0.0), ended & mask, late & mask
        return reward, ended, late

    def close(self) -> None:
        """Release the backends of the robots and of the filter."""
        self.simulator.close()
        if self.filter is not None:
            self.filter.close()

    def info(self) -> dict[str, Array]:
        """`info` of every row: see `LiveFilter.info`; without a filter, the truth."""
        if self.filter is None:
            return {"truth": self.simulator.x.copy()}
        with quiet():
            return self.filter.info(self.simulator.x)
