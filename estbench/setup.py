"""From a validated scenario to the objects of an experiment: models, sensors, schedule, noise."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench import controllers, schedules, sensors, starting, timing
from estbench import scenario as scenarios
from estbench.errors import (
    CovarianceError,
    DimensionError,
    EstimatorError,
    ScenarioError,
    did_you_mean,
)
from estbench.estimators import registry
from estbench.estimators.adaptive import AdaptiveEKF
from estbench.estimators.base import Estimator
from estbench.filtering import Delays
from estbench.linalg import is_positive_definite
from estbench.manifold import Manifold
from estbench.models import layout, mjcf
from estbench.models.differences import Differences
from estbench.models.disturbance import Disturbance
from estbench.models.mujoco import MujocoModel, SensorChannel, whole_steps
from estbench.models.reading import Source
from estbench.naming import expand
from estbench.records import RESERVED
from estbench.scenario import (
    BelievedChannelSection,
    FilterSection,
    InitialSection,
    ProcessNoiseSection,
    Scenario,
    StartSection,
)
from estbench.sensors import Channel
from estbench.smoothers.estimators import MAP
from estbench.timing import Instant, Native
from estbench.truth import Simulator

Array = NDArray[np.float64]

DEFAULT_DENSITY = 0.01


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that is the same for all runs; what one batch needs is built by its methods.

    Attributes:
        scenario: what it was built from.
        plant: the nominal robot: truth model, state space, keyframe, control period.
        filter_model: the MuJoCo model as the filter believes it.
        filter_channels: the filter's sensors and R.
        channels: the true sensors.
        instants: the event loop's schedule.
        disturbance: the true process noise; the filter's is `filter_disturbance`.
        mean, cov: x̂₀ `(nx,)` and P₀ `(n, n)`.
        notices: what was assumed where the scenario is silent.
    """

    scenario: Scenario
    plant: controllers.Plant
    filter_model: mujoco.MjModel
    filter_channels: tuple[SensorChannel, ...]
    channels: tuple[Channel, ...]
    instants: tuple[Instant, ...]
    disturbance: Disturbance
    filter_disturbance: Disturbance
    mean: Array
    cov: Array
    notices: tuple[str, ...]

    @property
    def space(self) -> Manifold:
        """The state space."""
        return self.plant.space

    @property
    def times(self) -> Array:
        """Start and end of every instant `(K + 1,)`, s."""
        return np.array([0.0] + [i.end for i in self.instants])

    def model(self, nthread: int = 1, robot: mujoco.MjModel | None = None) -> MujocoModel:
        """A fresh filter model; one for each thread, or of another `robot` with the same state."""
        section = self.scenario.filter
        return MujocoModel(
            robot or self.filter_model,
            self.filter_channels,
            self.filter_disturbance,
            Differences(section.differences, section.step),
            nthread,
            self.plant.u0,
        )

    @property
    def channel_spaces(self) -> dict[str, Manifold]:
        """Channel -> the manifold of its readings, in the measurement's order."""
        return {c.name: c.space for c in self.channels}

    def estimator(self, label: str) -> Estimator:
        """The estimator of that label on a fresh model, started as the scenario says."""
        model, start = self.model(), self.start(label)
        settings = self.settings(label)
        if isinstance(settings.get("models"), list):
            settings["models"] = [self._varied(label, table) for table in settings["models"]]
        made = registry.create(label, settings, model)
        if start.method == "prior":
            return made
        return starting.WarmStart(made, model, start.window, start.method)

    def _varied(self, label: str, changes: Any) -> MujocoModel:
        """The filter's model with some parameters set, as one of the `models` of an estimator."""
        where = f"estimators.{label}.models"
        if not isinstance(changes, dict):
            raise ScenarioError(
                f"{where}: {changes!r} is no table; use one like that of filter.set"
            )
        return self.model(robot=mjcf.changed(self.filter_model, changes, where))

    def settings(self, label: str) -> dict[str, Any]:
        """The estimator's own settings, without those of the event loop."""
        settings = self.scenario.estimators[label]
        return {k: v for k, v in settings.items() if k not in ("delays", "start")}

    def start(self, label: str) -> StartSection:
        """How the estimator of that label starts."""
        return scenarios.start(self.scenario, label)

    def prior(self, label: str) -> tuple[Array, Array]:
        """x̂₀ `(nx,)` and P₀ `(n, n)` that the estimator of that label is given."""
        start, nq, nv = self.start(label), self.plant.model.nq, self.plant.model.nv
        mean, cov = starting.displaced(self.space, self.mean, self.cov, start.offset, start.inflate)
        if start.method == "static":
            speeds = slice(nq, nq + nv), slice(nv, 2 * nv)
            mean, cov = starting.at_rest(mean, cov, *speeds, start.rest_std)
        return mean, cov

    def delays(self, label: str) -> Delays:
        """What the estimator of that label does about late readings."""
        section, timestep = self.scenario.filter, float(self.plant.model.opt.timestep)
        handling = self.scenario.estimators[label].get("delays", section.delays)
        if handling not in ("exact", "naive"):
            raise EstimatorError(f"{label}: delays is {handling!r}; use 'exact' or 'naive'")
        believed = {
            name: round(channel.latency / timestep)
            for name, channel in section.channels.items()
            if channel.latency is not None
        }
        nominal = frozenset(n for n, c in section.channels.items() if c.timestamps == "due")
        return Delays(handling, self.window, believed, nominal)

    @property
    def window(self) -> int:
        """How far exact delay handling can go back, in physics steps."""
        section, timestep = self.scenario.filter, float(self.plant.model.opt.timestep)
        if section.window is not None:
            return int(section.window / timestep + 1e-9)
        late = [c.timing.longest for c in self.channels]
        late += [round((c.latency or 0.0) / timestep) for c in section.channels.values()]
        # A reading is fused at the first instant after its arrival, up to one interval later.
        slack = max(i.nstep for i in self.instants) if any(late) else 0
        return max(late, default=0) + slack

    def simulator(self, runs: Sequence[int]) -> Simulator:
        """The true robot for some runs."""
        return Simulator(
            self.plant.model,
            self.space,
            self.channels,
            self.instants,
            self.disturbance,
            (self.mean, np.asarray(np.linalg.cholesky(self.cov), np.float64)),
            self.scenario.truth.draw,
            self.scenario.simulation.seed,
            runs,
        )

    def controller(self, runs: Sequence[int]) -> controllers.Controller:
        """The controller for some runs, its errors made clear."""
        section = self.scenario.control
        steps = sum(i.control for i in self.instants)
        seed = self.scenario.simulation.seed
        made = controllers.build(section, self.plant, seed, runs, steps)
        name = section.function if section.kind == "user" else section.kind
        return controllers.checked(made, name or section.kind, self.plant.model.nu)


def build(scenario: Scenario) -> Setup:
    """Resolve a scenario.

    Raises:
        ScenarioError, DimensionError, CovarianceError, EstimatorError, ControllerError: whatever
            does not fit, before anything is simulated or written.
    """
    section, belief = scenario.model, scenario.filter
    added = {name: c.add for name, c in scenario.channels.items() if c.add is not None}
    spec = mjcf.read(section.path, added)
    truth = mjcf.compile_model(
        spec,
        timestep=section.timestep,
        integrator=section.integrator,
        settings={**section.set, **scenario.truth.set},
    )
    believed = mjcf.compile_model(
        mjcf.read(belief.path, added) if belief.path else spec,
        timestep=belief.timestep or section.timestep,
        integrator=belief.integrator or section.integrator,
        settings={**section.set, **belief.set},
        where="filter",
    )
    for name, model in (("model", truth), ("filter", believed)):
        if not model.opt.timestep > 0:
            raise ScenarioError(f"{name}.timestep is {model.opt.timestep:g} s; use one above 0")
    space = layout.state_space(truth)
    if not space.n:
        raise ScenarioError(
            f"model.path '{section.path}' has no joint: there is no state to estimate"
        )
    if layout.state_space(believed).names != space.names or believed.nu != truth.nu:
        raise DimensionError(
            f"filter.path: states {', '.join(layout.state_space(believed).names)} with "
            f"{believed.nu} controls; expected {', '.join(space.names)} with {truth.nu}"
        )
    duration = scenario.simulation.duration
    channels, notices = sensors.build(
        truth,
        scenario.channels,
        scenario.sensors,
        section.frame_skip,
        duration,
        _native_timing(spec, truth),
        belief.channels,
    )
    # MuJoCo would saturate the true reading, before the noise; a sensor does so after it.
    truth.sensor_cutoff[np.isfinite(sensors.native_cutoff(truth))] = 0.0
    x0, u0 = mjcf.keyframe(truth, section.keyframe)
    mean, cov = _initial(scenario.initial, truth, space, x0)
    instants = timing.instants(
        [(c.name, c.timing) for c in channels], truth.opt.timestep, section.frame_skip, duration
    )
    notices += _silent(channels, instants[-1])
    burn_in, end = scenario.consistency.burn_in, instants[-1].end
    if burn_in >= end:
        raise ScenarioError(
            f"consistency.burn_in is {burn_in:g} s, which leaves nothing of a run of {end:g} s; "
            "shorten it or raise simulation.duration"
        )
    for dt in {round(i.end - i.start, 12) for i in instants}:
        whole_steps(dt, believed.opt.timestep, "filter.timestep: an interval of")
    disturbance = _disturbance(scenario.process_noise, truth, space, duration, notices)
    _note_defaults(scenario, truth, notices)
    setup = Setup(
        scenario=scenario,
        plant=controllers.Plant(truth, space, x0, u0, section.frame_skip),
        filter_model=believed,
        filter_channels=_believed_channels(believed, channels, belief),
        channels=tuple(channels),
        instants=tuple(instants),
        disturbance=disturbance,
        filter_disturbance=disturbance.scaled(belief.process_noise_scale),
        mean=mean,
        cov=cov,
        notices=tuple(notices),
    )
    for label in scenario.estimators:
        if label in RESERVED or not re.fullmatch(r"(?!__)\w[\w.+-]*", label):
            raise ScenarioError(
                f"estimators: the label '{label}' cannot name a group of results; use letters, "
                f"digits, '.', '-', '+' or '_', but not {', '.join(sorted(RESERVED))}"
            )
        _check_lengths(setup, label, setup.estimator(label))
        setup.prior(label)
        setup.delays(label)
    _check_window(setup)
    for key in scenario.truth.draw:
        mjcf.parameter(truth, key, "truth.draw")
    setup.controller([0])
    return setup


def _disturbance(
    section: ProcessNoiseSection,
    model: mujoco.MjModel,
    space: Manifold,
    duration: float,
    notices: list[str],
) -> Disturbance:
    """The true process noise."""
    density = section.density
    if density is None:
        density = DEFAULT_DENSITY
        if section.kind == "additive":
            # Noise on the velocities alone: positions then move as their derivatives say.
            values = np.zeros(space.n)
            values[model.nv : 2 * model.nv] = DEFAULT_DENSITY
            density = values.tolist()
        if section.matrix is None:
            what = {"additive": "every velocity, (unit)²/s", "force": "every force, (N or N m)² s"}
            where = what.get(section.kind, "every control, (unit)² s")
            notices.append(f"no process_noise.density given; assuming {DEFAULT_DENSITY} on {where}")
    disturbance = Disturbance.build(model, space, section.kind, density, section.matrix)
    axes, where = len(disturbance.density), "process_noise.schedule"
    schedule = schedules.build(section.schedule, axes, duration, where)
    if schedule is not None:
        disturbance = replace(disturbance, schedule=schedule.at)
    if not disturbance.rank:
        notices.append("process noise is zero: an estimator's gain will vanish with time")
    return disturbance


def _note_defaults(scenario: Scenario, model: mujoco.MjModel, notices: list[str]) -> None:
    """Say which defaults stand in for sections that the scenario leaves out."""
    given = scenario.model_fields_set
    if scenario.model.keyframe is None:
        first = f"the first keyframe, '{model.key(0).name}'" if model.nkey else "qpos0 at rest"
        notices.append(f"no model.keyframe given; starting about {first}")
    if "initial" not in given:
        notices.append(f"no [initial] given; assuming a std of {scenario.initial.std} everywhere")
    if "control" not in given:
        notices.append("no [control] given; holding the nominal control")
    if "simulation" not in given:
        simulation = scenario.simulation
        notices.append(
            f"no [simulation] given; {simulation.runs} runs of {simulation.duration:g} s, "
            f"seed {simulation.seed}"
        )


def _initial(
    section: InitialSection, model: mujoco.MjModel, space: Manifold, x0: Array
) -> tuple[Array, Array]:
    """x̂₀ and P₀."""
    mean = x0.copy()
    parts = {
        "qpos": slice(0, model.nq),
        "qvel": slice(model.nq, model.nq + model.nv),
        "act": slice(model.nq + model.nv, None),
    }
    for name, part in parts.items():
        given = getattr(section, name)
        if given is not None:
            if len(given) != len(mean[part]):
                raise DimensionError(
                    f"initial.{name} has {len(given)} values; expected {len(mean[part])}"
                )
            mean[part] = given
    mean = space.plus(mean, np.zeros(space.n))  # unit quaternions
    if section.cov is None:
        std = expand(section.std, space.names, "initial.std")
        if not (std > 0).all():
            worst = int(std.argmin())
            raise CovarianceError(
                f"initial.std is {std[worst]:g} for {space.names[worst]}; P₀ must be positive "
                "definite, so give every coordinate a std above 0 (later patterns win)"
            )
        return mean, np.diag(std**2)
    cov = np.asarray(section.cov, dtype=np.float64)
    if cov.shape != (space.n, space.n):
        raise DimensionError(
            f"initial.cov has shape {cov.shape}; expected {(space.n, space.n)} "
            f"({', '.join(space.names)})"
        )
    if not is_positive_definite(cov):
        raise CovarianceError("initial.cov (P₀) is not symmetric positive definite")
    return mean, cov


def _believed_channels(
    model: mujoco.MjModel, channels: Sequence[Channel], section: FilterSection
) -> tuple[SensorChannel, ...]:
    """The channels as the filter believes them, their sensors found by name in its model."""
    names = [layout.sensor_name(model, i) for i in range(model.nsensor)]
    known = [c.name for c in channels]
    for name in section.channels:
        if name not in known:
            raise ScenarioError(f"filter.channels: no channel '{name}'{did_you_mean(name, known)}")
    out = []
    for channel in channels:
        belief = section.channels.get(channel.name, BelievedChannelSection())
        R = section.measurement_noise_scale * sensors.believed_covariance(channel, belief)
        follow = channel.schedule is not None and belief.follow_schedule
        scale = channel.schedule.at if channel.schedule is not None and follow else None
        source = channel.source
        if not source.function:
            missing = [name for name in channel.sensors if name not in names]
            if missing:
                raise ScenarioError(
                    f"filter.path: the filter's model has no sensor {', '.join(missing)}"
                )
            indices = [names.index(name) for name in channel.sensors]
            source = Source.of_sensors(model, *indices, axes=source.axes)
        out.append(SensorChannel(channel.name, -1, R, scale, source))
    return tuple(out)


def _native_timing(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, Native]:
    """Sensor -> its rhythm by the MJCF, for the sensors that have a history."""
    return {
        layout.sensor_name(model, i): Native(
            float(sensor.interval[0]), float(sensor.interval[1]), float(sensor.delay),
            int(sensor.nsample),
        )
        for i, sensor in enumerate(spec.sensors)
        if sensor.nsample > 0
    }  # fmt: skip


def _silent(channels: Sequence[Channel], last: Instant) -> list[str]:
    """A notice of each channel of which nothing can arrive before the run ends."""
    notices = []
    for channel in channels:
        due = channel.timing.due(last.tick)
        if not len(due) or due[0] + channel.timing.latency > last.tick:
            notices.append(
                f"{channel.name}: its first reading would arrive after the run of {last.end:g} s"
            )
    return notices


def _check_window(setup: Setup) -> None:
    """Refuse a latency that exact handling could never go back to."""
    section, timestep = setup.scenario.filter, float(setup.plant.model.opt.timestep)
    if section.window is None:
        return
    exact = any(setup.delays(label).handling == "exact" for label in setup.scenario.estimators)
    for channel in setup.channels:
        belief = section.channels.get(channel.name, BelievedChannelSection())
        late = channel.timing.latency * timestep if belief.latency is None else belief.latency
        if exact and late > setup.window * timestep + 1e-9:
            raise ScenarioError(
                f"filter.window is {section.window:g} s but channel '{channel.name}' is {late:g} s "
                "late: it would never be fused; raise the window"
            )


def _check_lengths(setup: Setup, label: str, estimator: Any) -> None:
    """Refuse windows that are longer than the run."""
    end, arrivals = setup.instants[-1].end, sum(bool(i.channels) for i in setup.instants)
    start = setup.start(label)
    inner = estimator.estimator if isinstance(estimator, starting.WarmStart) else estimator
    if start.method != "prior" and start.window >= end:
        raise EstimatorError(
            f"{label}: start.window is {start.window:g} s but the run only {end:g} s; shorten it"
        )
    if isinstance(inner, MAP) and inner.window is not None and inner.window > end + 1e-9:
        raise EstimatorError(
            f"{label}: window is {inner.window:g} s but the run only {end:g} s; shorten it, or "
            "leave it out for the whole run"
        )
    asked = "window" in setup.settings(label)  # the default may look beyond a short run
    if isinstance(inner, AdaptiveEKF) and asked and inner.window > arrivals:
        raise EstimatorError(
            f"{label}: window is {inner.window} arrivals but the run has {arrivals}; shorten it"
        )
