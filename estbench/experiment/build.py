"""From the sections of a scenario to objects: robots, noise, initial belief, channels, notices."""

from collections.abc import Sequence

import mujoco
import numpy as np

from estbench.errors import CovarianceError, DimensionError, ScenarioError, did_you_mean
from estbench.robots import layout, mjcf, parameters
from estbench.robots.disturbance import Disturbance
from estbench.robots.measurement import Measurand
from estbench.robots.model import Scale, SensorChannel
from estbench.scenario.schema import (
    BelievedChannelSection,
    FilterSection,
    InitialSection,
    ProcessNoiseSection,
    Scenario,
)
from estbench.sensors import channel as sensors
from estbench.sensors import datasheet, schedules
from estbench.sensors.channel import Channel
from estbench.sensors.timing import Instant, MjcfTiming
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold
from estbench.spaces.patterns import expand

DEFAULT_DENSITY = 0.01


def robots(scenario: Scenario) -> tuple[mujoco.MjSpec, mujoco.MjModel, mujoco.MjModel]:
    """The robot's MJCF specification, the true model, and the filter's model.

    Raises:
        ScenarioError: a model cannot be compiled, or has no state.
        DimensionError: the two models have different states or controls.
    """
    section, belief = scenario.model, scenario.filter
    added = {name: c.add for name, c in scenario.channels.items() if c.add is not None}
    spec = mjcf.read(section.path, added)
    truth = mjcf.compile_model(
        spec,
        timestep=section.timestep,
        integrator=section.integrator,
        settings=section.set,
    )
    believed = mjcf.compile_model(
        mjcf.read(belief.path, added) if belief.path else spec,
        timestep=belief.timestep or section.timestep,
        integrator=belief.integrator or section.integrator,
        settings=section.set,
        where="filter" if belief.path else "model",
    )
    truth = parameters.changed(truth, scenario.truth.set, "truth.set")
    believed = parameters.changed(believed, belief.set, "filter.set")
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
    return spec, truth, believed


def disturbance(
    section: ProcessNoiseSection,
    model: mujoco.MjModel,
    space: Manifold,
    duration: float,
    notices: list[str],
) -> Disturbance:
    """The true process noise.

    Args:
        section: the scenario's `[process_noise]`.
        model: the true model.
        space: the state space.
        duration: length of each run, s.
        notices: assumptions are appended here.

    Raises:
        ScenarioError, CovarianceError, DimensionError: the section does not fit the model.
    """
    if section.accelerometer_sees == "disturbance" and section.kind == "additive":
        raise ScenarioError(
            "process_noise.accelerometer_sees is 'disturbance' but kind is 'additive', a change of "
            "the state that no sensor feels; use kind = 'force' or 'actuator'"
        )
    density, assumed = section.density, ""
    if density is None:
        density = DEFAULT_DENSITY
        if section.kind == "additive":
            # On the velocities only, so that positions stay the integrals of velocities.
            values = np.zeros(space.n)
            values[model.nv : 2 * model.nv] = DEFAULT_DENSITY
            density = values.tolist()
        if section.matrix is None:
            what = {"additive": "every velocity, (unit)²/s", "force": "every force, (N or N m)² s"}
            assumed = what.get(section.kind, "every control, (unit)² s")
    disturbance = Disturbance.build(model, space, section.kind, density, section.matrix)
    axes, where = len(disturbance.density), "process_noise"
    schedule = schedules.build(section.schedule, axes, duration, f"{where}.schedule", "Q_s")
    notices += schedules.unused(schedule, section, ("density", "matrix"), where)
    if schedule is not None:
        disturbance = disturbance.scheduled(schedule.at)
    if assumed and schedules.initial_covariance(schedule) is None:
        notices.append(f"no process_noise.density given; assuming {DEFAULT_DENSITY} on {assumed}")
    if not disturbance.rank:
        notices.append("process noise is zero: an estimator's gain will vanish with time")
    return disturbance


def note_defaults(scenario: Scenario, model: mujoco.MjModel, notices: list[str]) -> None:
    """Append a notice for each section that the scenario leaves out, with its default."""
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


def initial(
    section: InitialSection, model: mujoco.MjModel, space: Manifold, x0: Float[Array, " nx"]
) -> tuple[Float[Array, " nx"], Float[Array, "n n"]]:
    """x̂₀ and P₀.

    Raises:
        CovarianceError: P₀ is not positive semidefinite.
        DimensionError: the count of values or the shape of P₀ is wrong.
    """
    mean = x0.copy()
    blocks = {
        "qpos": slice(0, model.nq),
        "qvel": slice(model.nq, model.nq + model.nv),
        "act": slice(model.nq + model.nv, None),
    }
    for name, block in blocks.items():
        given = getattr(section, name)
        if given is not None:
            if len(given) != len(mean[block]):
                raise DimensionError(
                    f"initial.{name} has {len(given)} values; expected {len(mean[block])}"
                )
            mean[block] = given
    mean = space.plus(mean, np.zeros(space.n))  # unit quaternions
    if section.cov is None:
        std = expand(section.std, space.names, "initial.std")
        if not (std >= 0).all():
            worst = int(std.argmin())
            raise CovarianceError(
                f"initial.std is {std[worst]:g} for {space.names[worst]}; use a std of at least 0, "
                "0 for a coordinate that is known exactly (later patterns win)"
            )
        return mean, np.diag(std**2)
    return mean, datasheet.matrix(section.cov, space, "initial.cov", "P₀", definite=False)


def believed_channels(
    model: mujoco.MjModel, channels: Sequence[Channel], section: FilterSection, duration: float
) -> tuple[SensorChannel, ...]:
    """The channels as the filter believes them; their sensors are found by name in its model.

    Args:
        model: the filter's model.
        channels: the true channels.
        section: the scenario's `[filter]`.
        duration: length of each run, s.

    Raises:
        ScenarioError: an unknown channel, or a sensor that the filter's model lacks.
    """
    names = [layout.sensor_name(model, i) for i in range(model.nsensor)]
    known = [c.name for c in channels]
    for name in section.channels:
        if name not in known:
            raise ScenarioError(f"filter.channels: no channel '{name}'{did_you_mean(name, known)}")
    out = []
    for channel in channels:
        belief = section.channels.get(channel.name, BelievedChannelSection())
        R, scale = _believed_noise(channel, belief, section.measurement_noise_scale, duration)
        measurand = channel.measurand
        if not measurand.function:
            missing = [name for name in channel.sensors if name not in names]
            if missing:
                raise ScenarioError(
                    f"filter.path: the filter's model has no sensor {', '.join(missing)}"
                )
            indices = [names.index(name) for name in channel.sensors]
            measurand = Measurand.of_sensors(model, *indices, axes=measurand.axes)
        out.append(SensorChannel(channel.name, -1, R, scale, measurand))
    return tuple(out)


def _believed_noise(
    channel: Channel, belief: BelievedChannelSection, scale: float, duration: float
) -> tuple[Float[Array, "m m"], Scale | None]:
    """R of a channel as the filter believes it, and its scale over time or None.

    Raises:
        ScenarioError: a constant R and a schedule of full covariances are both given.
    """
    where = f"filter.channels.{channel.name}"
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


def mjcf_timings(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, MjcfTiming]:
    """Sensor -> timing that the MJCF gives, for the sensors with a history."""
    return {
        layout.sensor_name(model, i): MjcfTiming(
            float(sensor.interval[0]), float(sensor.interval[1]), float(sensor.delay),
            int(sensor.nsample),
        )
        for i, sensor in enumerate(spec.sensors)
        if sensor.nsample > 0
    }  # fmt: skip


def silent(channels: Sequence[Channel], last: Instant) -> list[str]:
    """One notice per channel of which no reading can arrive before the end of the run."""
    notices = []
    for channel in channels:
        due = channel.timing.due(last.tick)
        if not len(due) or due[0] + channel.timing.latency > last.tick:
            notices.append(
                f"{channel.name}: its first reading would arrive after the run of {last.end:g} s"
            )
    return notices
