"""Sensors and filters for environments of other libraries: the common part of both wrappers."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estbench.envs.adopt import adopt
from estbench.envs.errors import EnvError, check_threads
from estbench.envs.features import Features
from estbench.envs.following import Following
from estbench.envs.member import Member
from estbench.envs.prior import Prior
from estbench.errors import CovarianceError, EstimatorError, did_you_mean
from estbench.estimators import registry
from estbench.estimators.protocol import depends_on_time
from estbench.experiment.starts import default_std, still
from estbench.inference.fusion import Delays
from estbench.inference.live import LiveFilter
from estbench.randomness import streams
from estbench.randomness.streams import Seeds
from estbench.robots import backend, layout, parameters
from estbench.robots.disturbance import Disturbance
from estbench.robots.fields import Fields
from estbench.robots.held import REST, held, note
from estbench.robots.model import MujocoModel
from estbench.sensors.clock import Clocks, Event
from estbench.sensors.suite import SensorSuite
from estbench.sensors.timing import Instant, Schedule
from estbench.shapes import Array, Ints, Mask
from estbench.spaces.patterns import expand

_log = logging.getLogger("estbench")


class Watch:
    """Sensors and filters on `rows` copies of an environment.

    The arguments are those of `estbench.envs.wrapper.EstimatedObservation`; `member` is one of the
    copies, whose model is the first of all.

    Attributes:
        suite: the sensors.
        filter: the beliefs of the robots, or None.
        clocks: where each row is in its episode.
        space: the state space.
        frame_skip: physics steps of a step.
    """

    def __init__(
        self,
        member: Member,
        rows: int,
        estimator: str | Mapping[str, Any],
        sensors: str | Path | Sequence[str] | Mapping[str, Any] | None,
        process_noise: float | Mapping[str, Any],
        initial_std: float | Sequence[float] | dict[str, float] | None,
        model_set: Mapping[str, float | Sequence[float]] | None,
        follow: bool,
        frame_skip: int,
        filtered: bool = True,
        nthread: int | None = 1,
    ):
        check_threads(nthread)
        name, self.frame_skip = type(member.env.unwrapped).__name__, frame_skip
        adopted = adopt(member.model, sensors, frame_skip)
        model, self._timestep = adopted.model, float(member.model.opt.timestep)
        self._assumed, self._after = adopted.notices, 1 + model.nq + model.nv + model.na
        self.space = layout.state_space(model)
        unsaid = initial_std is None
        std = expand(
            default_std(model).tolist() if initial_std is None else initial_std,
            self.space.names,
            "initial_std",
        )
        if not (std >= 0).all():
            raise CovarianceError(
                f"initial_std is {std.min():g}; a standard deviation is at least 0"
            )
        if unsaid or np.isscalar(initial_std):
            std = np.where(still(model), 0.0, std)
            if std.size and held(model).any():
                self._assumed += (note(model, self.space.names),)
        for line in self._assumed:
            _log.warning("%s: %s", name, line)
        self._std, self._prior = std, Prior(model, std)
        self._backend = backend.create(model, nthread)
        self.suite = SensorSuite(model, self._backend, adopted.channels, rows, look=not filtered)
        timed, window = False, 0
        believed: MujocoModel | None = None
        self.filter: LiveFilter | None = None
        if filtered:
            believed = MujocoModel(
                parameters.changed(model, model_set or {}, "model_set"),
                adopted.believed,
                _disturbance(model, self.space, process_noise),
                nthread=nthread,
            )
            made, latest = _estimator(estimator, believed), frame_skip
            latest += max((c.timing.longest_delay for c in adopted.channels), default=0)
            window = latest if latest > frame_skip else 0
            spaces = {c.name: c.space for c in adopted.channels}
            own = type(made).__module__.startswith("estbench.")
            timed = not own or depends_on_time(made)
            timed = timed or any(
                c.schedule is not None or c.measurand.depends_on_time(model)
                for c in adopted.channels
            )
            self.filter = LiveFilter(
                made, self.space, spaces, rows, Delays(window=window), by_clock=timed
            )
        self._following = Following(
            name, model, self._backend, believed, model_set or {}, follow, rows, window
        )
        if self.filter is not None:
            self._try(self.filter, member)
        self.clocks = Clocks(rows, Schedule((), self._timestep, frame_skip), timed)

    @property
    def notices(self) -> tuple[str, ...]:
        """Assumptions, and what was found since, one line each."""
        return (*self._assumed, *self._following.notices)

    def adapt(self, row: int, fields: Fields | None) -> None:
        """A row has a model with these fields from now on; None for no change.

        Raises:
            EnvError: it is not of the same sizes.
        """
        if fields is not None:
            self._following.adapt(row, fields, self.clocks.tick)

    def divided(self, states: Array) -> tuple[Array, Array]:
        """True states `(row, nx)` and inputs `(row, inputs)` of what `Member.state` gives."""
        return states[:, 1 : self._after], states[:, self._after :]

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

    def reset(self, rows: Ints, seed: Seeds, runs: Sequence[int], x: Array, inputs: Array) -> None:
        """Start filters at x̂₀ with x ⊖ x̂₀ ~ N(0, P₀) in some rows.

        Args:
            rows: their numbers.
            seed: of all of them, or one for each.
            runs: the number of the run in each.
            x: true states of all rows `(row, nx)`.
            inputs: all of them `(row, inputs)`.
        """
        self.clocks.start(rows)
        u, _ = self._following.inputs(inputs)
        self.suite.start(rows, seed, runs, self.clocks.tick, x, u)
        if self.filter is None:
            return
        white = streams.normals(seed, runs, "initial", 1, self.space.n)[0]
        n = self.space.n
        error, cov = np.zeros((len(x), n)), np.zeros((len(x), n, n))
        error[rows], cov[rows] = self._prior.errors(x[rows], inputs[rows], white)
        keys = None
        if self.filter.random:
            keys = np.zeros(len(x), np.uint64)
            keys[rows] = streams.run_keys(seed, runs, "estimator")
        self.filter.start(rows, self.space.plus(x, -error), cov, keys)

    def step(self, nstep: int, x: Array, inputs: Array, mask: Mask | None = None) -> None:
        """Go on by `nstep` physics steps, to the true states x `(row, nx)`; under `quiet`.

        Args:
            nstep: physics steps.
            x: true states at their end.
            inputs: all inputs `(row, inputs)` that were held.
            mask: rows that take part; None is all.
        """
        u, known = self._following.inputs(inputs)
        if self.filter is not None:
            self.filter.begin()
        for event in self.clocks.interval(nstep, mask):
            _, end = self.clocks.time(event)
            arrived = self.suite.read(event.tick, end, x, u, event.rows)
            if self.filter is not None:
                self.filter.step(event, known, arrived)
        if self.filter is not None:
            self.filter.settle()

    def close(self) -> None:
        """Release the backends of the sensors and of the filter."""
        self._backend.close()
        self._following.close()
        if self.filter is not None:
            self.filter.close()

    def info(self, x: Array) -> dict[str, Any]:
        """`info` of every row: see `LiveFilter.info`; without a filter, the truth."""
        return {"truth": x.copy()} if self.filter is None else self.filter.info(x)

    def features(self, observe: str) -> Features:
        """The observation of a kind."""
        return Features(observe, self.suite, self.filter, self.space.nx)

    def _try(self, tried: LiveFilter, member: Member) -> None:
        """Predict once from where the environment is: can the estimator use this model?"""
        rows, state = tried.rows, member.state()[None]
        mean, inputs = (np.repeat(part, rows, axis=0) for part in self.divided(state))
        _, cov = self._prior.errors(mean, inputs, np.zeros((rows, self.space.n)))
        _, u = self._following.inputs(inputs)
        nstep, keys = self.frame_skip, np.zeros(rows, np.uint64)
        instant = Instant(0.0, nstep * self._timestep, nstep, (), True, nstep)
        tried.start(np.arange(rows), mean, cov, keys)
        tried.step(Event(nstep, instant), u, [])
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
        velocities = np.where(held(model), REST, 1.0) * given
        return Disturbance.build(
            model, space, "additive", [*np.zeros(model.nv), *velocities, *np.zeros(model.na)]
        )
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
