"""Sensors and filters for environments of other libraries: the common part of both wrappers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estbench.envs.adopt import adopt, mujoco_parts
from estbench.envs.errors import EnvError
from estbench.envs.features import Features
from estbench.errors import CovarianceError, EstimatorError, did_you_mean
from estbench.estimators import registry
from estbench.estimators.protocol import depends_on_time
from estbench.inference.fusion import Delays
from estbench.inference.live import LiveFilter
from estbench.randomness import streams
from estbench.randomness.streams import Seeds
from estbench.robots import backend, layout, parameters
from estbench.robots.controls import ControlRange
from estbench.robots.disturbance import Disturbance
from estbench.robots.model import MujocoModel
from estbench.sensors.clock import Clocks, Event
from estbench.sensors.suite import SensorSuite
from estbench.sensors.timing import Instant, Schedule
from estbench.shapes import Array, Ints, Mask
from estbench.spaces.linalg import quiet
from estbench.spaces.patterns import expand


class Watch:
    """Sensors and filters on `rows` copies of an environment.

    The arguments are those of `estbench.envs.wrapper.EstimatedObservation`; `env` is one of the
    copies.

    Attributes:
        suite: the sensors.
        filter: the beliefs of the robots, or None.
        clocks: where each row is in its episode.
        space: the state space.
        data: `env`'s MuJoCo data, to be read only.
        notices: assumptions, one line each.
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
        self._range = ControlRange.of(adopted.model)
        self._backend = backend.create(adopted.model, nthread)
        self.suite = SensorSuite(
            adopted.model, self._backend, adopted.channels, rows, look=not filtered
        )
        timed = False
        self.filter: LiveFilter | None = None
        if filtered:
            believed = MujocoModel(
                parameters.changed(adopted.model, model_set or {}, "model_set"),
                adopted.believed,
                _disturbance(adopted.model, self.space, process_noise),
                nthread=nthread,
            )
            made, latest = _estimator(estimator, believed), self.frame_skip
            latest += max((c.timing.longest_delay for c in adopted.channels), default=0)
            window = latest if latest > self.frame_skip else 0
            spaces = {c.name: c.space for c in adopted.channels}
            own = type(made).__module__.startswith("estbench.")
            timed = not own or depends_on_time(made)
            timed = timed or any(
                c.schedule is not None or c.measurand.depends_on_time(adopted.model)
                for c in adopted.channels
            )
            self.filter = LiveFilter(
                made, self.space, spaces, rows, Delays(window=window), by_clock=timed
            )
            self._try(self.filter, rows)
        self.clocks = Clocks(rows, Schedule((), self._timestep, self.frame_skip), timed)

    def steps(self, elapsed: float) -> int:
        """Physics steps in the time that an environment's step took, s.

        Raises:
            EnvError: it is no positive integer.
        """
        count = round(elapsed / self._timestep)
        if count < 1 or abs(elapsed - count * self._timestep) > 1e-6 * count * self._timestep:
            raise EnvError(
                f"a step moved the environment's data.time by {elapsed:g} s, which is no multiple "
                f"of its timestep {self._timestep:g} s; a filter cannot follow it"
            )
        return count

    def reset(self, rows: Ints, seed: Seeds, runs: Sequence[int], x: Array, u: Array) -> None:
        """Start filters at x̂₀ with x ⊖ x̂₀ ~ N(0, P₀) in some rows.

        Args:
            rows: their numbers.
            seed: of all of them, or one for each.
            runs: the number of the run in each.
            x: true states of all rows `(row, nx)`.
            u: controls `(row, nu)`.
        """
        self.clocks.start(rows)
        self.suite.start(rows, seed, runs, self.clocks.tick, x, self._range.clamp(u))
        if self.filter is None:
            return
        error = np.zeros((len(x), self.space.n))
        error[rows] = self._std * streams.normals(seed, runs, "initial", 1, self.space.n)[0]
        keys = np.zeros(len(x), np.uint64)
        keys[rows] = streams.run_keys(seed, runs, "estimator")
        self.filter.start(rows, self.space.plus(x, -error), self._cov, keys)

    def step(self, nstep: int, x: Array, u: Array, mask: Mask | None = None) -> None:
        """Go on by `nstep` physics steps under u `(row, nu)`, to the true states x `(row, nx)`."""
        u = self._range.clamp(u)
        if self.filter is not None:
            self.filter.begin()
        with quiet():
            for event in self.clocks.interval(nstep, mask):
                _, end = self.clocks.time(event)
                arrived = self.suite.read(event.tick, end, x, u, event.rows)
                if self.filter is not None:
                    self.filter.step(event, u, arrived)
            if self.filter is not None:
                self.filter.settle()

    def __getstate__(self) -> dict[str, Any]:
        """Without the data of the environment: those of a copy are set by its wrapper."""
        return {name: value for name, value in vars(self).items() if name != "data"}

    def close(self) -> None:
        """Release the backends of the sensors and of the filter."""
        self._backend.close()
        if self.filter is not None:
            self.filter.close()

    def info(self, x: Array) -> dict[str, Any]:
        """`info` of every row: see `LiveFilter.info`; without a filter, the truth."""
        return {"truth": x.copy()} if self.filter is None else self.filter.info(x)

    def features(self, observe: str) -> Features:
        """The observation of a kind."""
        return Features(observe, self.suite, self.filter, self.space.nx)

    def _try(self, tried: LiveFilter, rows: int) -> None:
        """Predict once from the model's reference pose: can the estimator use this model?"""
        rest = np.concatenate([self.data.model.qpos0, np.zeros(self.space.nx - self.data.model.nq)])
        mean = np.repeat(rest[None], rows, axis=0)
        nstep, keys = self.frame_skip, np.zeros(rows, np.uint64)
        instant = Instant(0.0, nstep * self._timestep, nstep, (), True, nstep)
        tried.start(np.arange(rows), mean, self._cov, keys)
        tried.step(Event(nstep, instant), np.zeros((rows, self.data.model.nu)), [])
        tried.settle()
        if tried.failed.any():
            zero = [n for n, s in zip(self.space.names, self._std) if s == 0]
            remedy = (
                f"initial_std is 0 for {zero[0]}, and it needs a positive definite P₀: give every "
                "coordinate a std above 0, or use 'ekf'"
                if zero
                else "its first prediction is not finite; choose another estimator or process_noise"
            )
            raise EstimatorError(f"estimator {type(tried.estimator).__name__}: {remedy}")


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
    if given.get("accelerometer_sees", "control") != "control":
        raise EnvError(
            "process_noise.accelerometer_sees is for robots that estbench simulates: it does not "
            "know the disturbance of another library's environment; remove it"
        )
    kinds = ("additive", "force", "actuator")
    kind = given.get("kind", "additive")
    if kind not in kinds:
        raise EnvError(f"process_noise.kind is '{kind}'{did_you_mean(str(kind), kinds)}")
    return Disturbance.build(model, space, kind, given.get("density", 0.0), given.get("matrix"))
