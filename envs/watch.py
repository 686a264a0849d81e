"""Sensors and filters for environments not our own: what both wrappers do with true states."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estbench.envs.adopt import adopt, mujoco_parts
from estbench.envs.errors import EnvError
from estbench.envs.filter import FilterBank
from estbench.envs.keys import Keys, Mask, purpose
from estbench.envs.observer import Observer
from estbench.envs.readings import Readings
from estbench.errors import CovarianceError, EstimatorError, did_you_mean
from estbench.estimators import registry
from estbench.randomness import counter as random
from estbench.robots import layout, parameters
from estbench.robots.disturbance import Disturbance
from estbench.robots.model import MujocoModel, SensorChannel
from estbench.shapes import Array
from estbench.spaces.linalg import quiet
from estbench.spaces.patterns import expand


class Watch:
    """Sensors and filters on `rows` copies of an environment.

    The arguments are those of `estbench.envs.wrapper.EstimatedObservation`; `env` is one of the
    copies.

    Attributes:
        observer: sensors and filters.
        space: the state space.
        data: `env`'s MuJoCo data, to be read only.
        notices: what was assumed.
        frame_skip: physics steps of a step.
    """

    def __init__(
        self,
        env: Any,
        rows: int,
        estimator: str | Mapping[str, Any],
        sensors: str | Path | Sequence[str] | Mapping[str, Any] | None,
        process_noise: float | Mapping[str, Any],
        initial_std: float | Sequence[float] | dict[str, float],
        model_set: Mapping[str, float | Sequence[float]] | None,
        xml: str | Path | None,
        filtered: bool = True,
        nthread: int = 1,
    ):
        model, self.data = mujoco_parts(env)
        self.frame_skip = int(getattr(env.unwrapped, "frame_skip", 1))
        adopted = adopt(env, sensors, xml, self.frame_skip)
        self.notices, self._timestep = adopted.notices, float(model.opt.timestep)
        self.space = layout.state_space(adopted.model)
        std = expand(initial_std, self.space.names, "initial_std")
        if not (std >= 0).all():
            raise CovarianceError(
                f"initial_std is {std.min():g}; a standard deviation is at least 0"
            )
        self._std, self._cov = std, np.repeat(np.diag(std**2)[None], rows, axis=0)
        readings = Readings(adopted.model, adopted.channels, rows, nthread, adopted.quiet)
        bank = None
        if filtered:
            believed = MujocoModel(
                parameters.changed(adopted.model, model_set or {}, "model_set"),
                [SensorChannel(c.name, c.index, c.cov) for c in adopted.channels],
                _disturbance(adopted.model, self.space, process_noise),
                nthread=nthread,
            )
            made = _estimator(estimator, believed)
            depth = readings.depth(self.frame_skip)
            bank = FilterBank(made, self.space, readings.slots, rows, depth=depth)
            self._try(bank, readings, rows)
        self.observer = Observer(adopted.model, readings, bank)

    def steps(self, elapsed: float) -> int:
        """Physics steps in the time that an environment's step took, s.

        Raises:
            EnvError: it is no positive whole number.
        """
        count = round(elapsed / self._timestep)
        if count < 1 or abs(elapsed - count * self._timestep) > 1e-6 * count * self._timestep:
            raise EnvError(
                f"a step moved the environment's data.time by {elapsed:g} s, which is no multiple "
                f"of its timestep {self._timestep:g} s; a filter cannot follow it"
            )
        return count

    def reset(self, mask: Mask, keys: Keys, x: Array, u: Array) -> None:
        """Start filters at x̂₀ with x ⊖ x̂₀ ~ N(0, P₀) in the rows of a mask.

        Args:
            mask: `(row,)`.
            keys: random keys of these rows `(mask.sum(),)`.
            x: true states of all rows `(row, nx)`.
            u: controls `(row, nu)`.
        """
        error = np.zeros((len(x), self.space.n))
        zero = np.zeros(len(keys), np.uint64)
        error[mask] = self._std * random.normal(keys, zero, purpose("initial"), self.space.n)
        self.observer.reset(mask, keys, x, u, self.space.plus(x, -error), self._cov)

    def step(self, nstep: int, x: Array, u: Array, mask: Mask | None = None) -> None:
        """Physics steps have passed under u `(row, nu)`, up to the true states x `(row, nx)`."""
        self.observer.begin()
        self.observer.advance(nstep, x, u, mask)

    def _try(self, bank: FilterBank, readings: Readings, rows: int) -> None:
        """One prediction from the model's rest, to see that the estimator can use this model."""
        rest = np.concatenate([self.data.model.qpos0, np.zeros(self.space.nx - self.data.model.nq)])
        mean = np.repeat(rest[None], rows, axis=0)
        u = np.zeros((rows, self.data.model.nu))
        with quiet():
            bank.reset(np.ones(rows, bool), mean, self._cov)
            bank.predict(u, 0.0, self.frame_skip * self._timestep)
            bank.settle()
        if bank.failed.any():
            zero = [n for n, s in zip(self.space.names, self._std) if s == 0]
            remedy = (
                f"initial_std is 0 for {zero[0]}, and it needs a positive definite P₀: give every "
                "coordinate a std above 0, or use 'ekf'"
                if zero
                else "its first prediction is not finite; choose another estimator or process_noise"
            )
            raise EstimatorError(f"estimator {type(bank.estimator).__name__}: {remedy}")


def _estimator(estimator: str | Mapping[str, Any], model: MujocoModel) -> Any:
    if isinstance(estimator, Mapping):
        if "type" not in estimator:
            raise EnvError(
                f"estimator is {dict(estimator)}; a table needs a type, e.g. "
                "{'type': 'ukf', 'alpha': 0.5}"
            )
        return registry.create(str(estimator["type"]), estimator, model)
    return registry.create(estimator, {}, model)


def _disturbance(model: Any, space: Any, given: float | Mapping[str, Any]) -> Disturbance:
    if not isinstance(given, Mapping):
        return Disturbance.build(
            model, space, "additive",
            [*np.zeros(model.nv), *np.full(model.nv, given), *np.zeros(model.na)],
        )  # fmt: skip
    if not {"kind", "density", "matrix"} & set(given):
        return Disturbance.build(model, space, "additive", dict(given))
    kinds = ("additive", "force", "actuator")
    kind = given.get("kind", "additive")
    if kind not in kinds:
        raise EnvError(f"process_noise.kind is '{kind}'{did_you_mean(str(kind), kinds)}")
    return Disturbance.build(model, space, kind, given.get("density", 0.0), given.get("matrix"))
