"""What an estimator believes of the robot: its model, process noise and sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from estbench.errors import DimensionError, ScenarioError, did_you_mean
from estbench.experiment import build as resolution
from estbench.robots import flags, given, layout, mjcf, parameters
from estbench.robots.disturbance import Disturbance, axis_names
from estbench.robots.intervals import whole_steps
from estbench.robots.measurement import Measurand
from estbench.robots.model import Scale, SensorChannel
from estbench.scenario.filter import BelievedChannelSection, BelievedNoiseSection, FilterSection
from estbench.scenario.schema import Scenario
from estbench.sensors import channel as sensors
from estbench.sensors import schedules
from estbench.sensors.channel import Channel
from estbench.sensors.timing import Instant
from estbench.shapes import Array, Float
from estbench.spaces.patterns import expand


@dataclass(frozen=True, eq=False)
class Believed:
    """The filter's side of a scenario, as it holds for one estimator.

    Attributes:
        section: `[filter]` with what the estimator overrides.
        base: the compiled model before `filter.set`.
        robot: the model with it.
        channels: the sensors and R.
        disturbance: the process noise.
    """

    section: FilterSection
    base: mujoco.MjModel
    robot: mujoco.MjModel
    channels: tuple[SensorChannel, ...]
    disturbance: Disturbance


def build(
    scenario: Scenario,
    section: FilterSection,
    truth: mujoco.MjModel,
    channels: Sequence[Channel],
    instants: Sequence[Instant],
    disturbance: Disturbance,
    where: str = "filter",
    like: Believed | None = None,
) -> Believed:
    """The filter's side of a scenario.

    Args:
        scenario: for what `section` leaves as it is.
        section: `[filter]`, or that of an estimator.
        truth: the true model.
        channels: the true channels.
        instants: of each run.
        disturbance: the true process noise.
        where: name of the section, for messages.
        like: another one of the scenario; its compiled model is taken if it is the same.

    Raises:
        ScenarioError, DimensionError, CovarianceError: the section does not fit the truth.
    """
    if like is not None and _structure(like.section) == _structure(section):
        base = like.base
    else:
        base = _compiled(scenario, section, truth, where)
        used = {name for channel in channels for name in channel.sensors}
        names = [layout.sensor_name(base, i) for i in range(base.nsensor)]
        flags.leave_out_sensors(base, {i for i, name in enumerate(names) if name in used})
        for dt in {round(i.end - i.start, 12) for i in instants}:
            whole_steps(dt, base.opt.timestep, f"{where}.timestep: an interval of")
    robot = parameters.changed(base, section.set, f"{where}.set")
    noise = _disturbance(disturbance, section.process_noise, truth, f"{where}.process_noise")
    return Believed(
        section,
        base,
        robot,
        _channels(robot, channels, section, scenario.simulation.duration, where),
        noise.scaled(section.process_noise_scale),
    )


def _structure(section: FilterSection) -> tuple[object, ...]:
    """What the compiled model depends on."""
    return section.path, section.timestep, section.integrator


def _compiled(
    scenario: Scenario, section: FilterSection, truth: mujoco.MjModel, where: str
) -> mujoco.MjModel:
    """The filter's model before `filter.set`.

    Raises:
        ScenarioError: it cannot be compiled.
        DimensionError: its states or controls are not those of the truth.
    """
    model = scenario.model
    base = mjcf.compile_model(
        mjcf.read(section.path or model.path, resolution.added_sensors(scenario)),
        timestep=section.timestep or model.timestep,
        integrator=section.integrator or model.integrator,
        settings=model.set,
        where=where if section.path else "model",
    )
    given.rest_as(base, truth, 0)
    resolution.check_timestep(base, where)
    found, expected = (layout.state_space(m).names for m in (base, truth))
    if found != expected or base.nu != truth.nu:
        raise DimensionError(
            f"{where}.path: states {', '.join(found)} with {base.nu} controls; expected "
            f"{', '.join(expected)} with {truth.nu}"
        )
    return base


def _disturbance(
    true: Disturbance,
    section: BelievedNoiseSection | None,
    model: mujoco.MjModel,
    where: str,
) -> Disturbance:
    """The process noise that the filter assumes, before its scale.

    Raises:
        ScenarioError: nothing is given, or the true schedule returns Q_s itself.
    """
    if section is None:
        return true
    if section.density is None and section.matrix is None:
        raise ScenarioError(f"{where} gives neither density nor matrix; give one of them")
    first = 1.0 if true.schedule is None else true.schedule(0.0)
    if np.ndim(first) == 2:
        raise ScenarioError(
            f"{where}: process_noise.schedule returns Q_s itself, which leaves nothing to assume; "
            "use filter.process_noise_scale"
        )
    kind, space = section.kind or true.kind, layout.state_space(model)
    density = section.density
    if isinstance(density, dict) and kind == true.kind:
        own = expand(density, axis_names(model, space, kind), f"{where}.density", np.nan)
        density = np.where(np.isnan(own), np.diag(true.density), own).tolist()
    made = Disturbance.build(
        model, space, kind, 0.0 if density is None else density, section.matrix, where
    )
    if true.schedule is None or (np.ndim(first) and kind != true.kind):
        return made
    return made.scheduled(true.schedule)


def _channels(
    model: mujoco.MjModel,
    channels: Sequence[Channel],
    section: FilterSection,
    duration: float,
    where: str,
) -> tuple[SensorChannel, ...]:
    """The channels as the filter believes them; their sensors are found by name in its model.

    Args:
        model: the filter's model.
        channels: the true channels.
        section: the scenario's `[filter]`, or that of an estimator.
        duration: length of each run, s.
        where: name of the section, for messages.

    Raises:
        ScenarioError: an unknown channel, or a sensor that the filter's model lacks.
    """
    names = [layout.sensor_name(model, i) for i in range(model.nsensor)]
    known = [c.name for c in channels]
    for name in section.channels:
        if name not in known:
            raise ScenarioError(f"{where}.channels: no channel '{name}'{did_you_mean(name, known)}")
    out = []
    for channel in channels:
        belief = section.channels.get(channel.name, BelievedChannelSection())
        scale, at = section.measurement_noise_scale, f"{where}.channels.{channel.name}"
        R, over_time = _noise(channel, belief, scale, duration, at)
        measurand = channel.measurand
        if not measurand.function:
            missing = [name for name in channel.sensors if name not in names]
            if missing:
                raise ScenarioError(
                    f"{where}.path: the filter's model has no sensor {', '.join(missing)}"
                )
            indices = [names.index(name) for name in channel.sensors]
            measurand = Measurand.of_sensors(model, *indices, axes=measurand.axes)
        out.append(SensorChannel(channel.name, -1, R, over_time, measurand))
    return tuple(out)


def _noise(
    channel: Channel, belief: BelievedChannelSection, scale: float, duration: float, where: str
) -> tuple[Float[Array, "m m"], Scale | None]:
    """R of a channel as the filter believes it, and its scale over time or None.

    Raises:
        ScenarioError: a constant R and a schedule of full covariances are both given.
    """
    own = schedules.build(belief.schedule, channel.space.n, duration, f"{where}.schedule")
    if own is None and belief.follow_schedule:
        own = channel.schedule
    R = schedules.initial_covariance(own)
    if R is not None and (belief.noise is not None or belief.cov is not None):
        raise ScenarioError(
            f"{where} has a constant R of its own, and follows a schedule of whole covariances; "
            "give one of them (follow_schedule = false, or a schedule of factors)"
        )
    R = scale * (sensors.believed_covariance(channel, belief) if R is None else R)
    return R, None if own is None else schedules.Scaled(own, scale).at
