"""From the sections of a scenario to objects: robots, noise, initial belief, channels, notices."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from estbench.errors import ScenarioError
from estbench.experiment.starts import default_number
from estbench.robots import added_sensors as adding
from estbench.robots import contacts, given, layout, mjcf, parameters
from estbench.robots.disturbance import Disturbance
from estbench.robots.held import REST, held, note
from estbench.scenario.channels import AddSensor
from estbench.scenario.schema import ContactSection, ProcessNoiseSection, Scenario
from estbench.sensors import schedules
from estbench.sensors.channel import Channel
from estbench.sensors.declared import expanded, is_open, lacks_sensors, names_expanded, usual
from estbench.sensors.timing import Instant, MjcfTiming
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold

DEFAULT_DENSITY = 0.01


def declared(scenario: Scenario, spec: mujoco.MjSpec) -> tuple[Scenario, frozenset[str]]:
    """The scenario with each sensor at one object, and the channels that it does not declare.

    A robot without any sensor gets those of `kit.default`; an entry for many objects becomes one
    for each, in `channels`, `filter.channels` and `sensors`.

    Raises:
        ScenarioError: an entry fits no object, or the MJCF does not compile.
    """
    given, use = scenario.channels, scenario.sensors
    lacking = lacks_sensors(len(spec.sensors), given, use)
    if not lacking and not any(s.add and is_open(s.add) for s in given.values()):
        return scenario, frozenset()
    model = mjcf.compile_model(spec)
    if lacking:
        made = usual(model, given)
        return scenario.model_copy(update={"channels": made}), frozenset(made) - frozenset(given)
    channels, several = expanded(model, given, "channels.{}.add.object")
    believed = _each(scenario.filter.channels, several)
    changed = {
        "estimators": _renamed(scenario.estimators, several),
        "channels": channels,
        "sensors": None if use is None else names_expanded(use, several),
        "filter": scenario.filter.model_copy(update={"channels": believed}),
    }
    return scenario.model_copy(update=changed), frozenset()


def _each(table: Mapping[str, Any], several: Mapping[str, list[str]]) -> dict[str, Any]:
    """A table per channel, with the channels of an entry for many objects in its place."""
    return {name: value for key, value in table.items() for name in several.get(key, [key])}


def _renamed(
    estimators: Mapping[str, dict[str, Any]], several: Mapping[str, list[str]]
) -> dict[str, dict[str, Any]]:
    """The tables of the estimators; their own `filter.channels` name the channels of `several`."""
    out = dict(estimators)
    for label, table in estimators.items():
        own = table.get("filter")
        if isinstance(own, dict) and isinstance(own.get("channels"), dict):
            out[label] = {**table, "filter": {**own, "channels": _each(own["channels"], several)}}
    return out


def robot(scenario: Scenario, spec: mujoco.MjSpec) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """The robot's MJCF specification with added sensors, and the true model.

    Raises:
        ScenarioError: the model cannot be compiled, or has no state.
    """
    section = scenario.model
    adding.add(spec, added_sensors(scenario), mjcf.locate(section.path).name)
    truth = mjcf.compile_model(
        spec,
        timestep=section.timestep,
        integrator=section.integrator,
        settings=section.set,
    )
    truth = parameters.changed(truth, scenario.truth.set, "truth.set")
    check_timestep(truth, "model")
    if not layout.state_space(truth).n:
        raise ScenarioError(
            f"model.path '{section.path}' has no joint: there is no state to estimate"
        )
    return spec, truth


def rest_mocap(model: mujoco.MjModel, keyframe: str | int | None) -> list[str]:
    """Put mocap bodies where a keyframe has them, for the whole run; a notice, if there are any."""
    if not model.nmocap:
        return []
    place = "the MJCF puts them"
    if model.nkey:
        number = mjcf.keyframe_number(model, keyframe)
        place = f"keyframe '{model.key(number).name or number}' puts them"
        given.rest_as(model, model, number)
    names = ", ".join(given.mocap_names(model))
    return [f"mocap bodies ({names}) stay where {place}; the filter knows it"]


def added_sensors(scenario: Scenario) -> dict[str, AddSensor]:
    """Channel -> the sensor that it adds to the model."""
    return {name: c.add for name, c in scenario.channels.items() if c.add is not None}


def check_timestep(model: mujoco.MjModel, where: str) -> None:
    """Refuse a timestep that is not positive."""
    if not model.opt.timestep > 0:
        raise ScenarioError(f"{where}.timestep is {model.opt.timestep:g} s; use one above 0")


def watched(scenario: Scenario, model: mujoco.MjModel) -> bool:
    """Whether the phases of contact of a robot are found.

    Raises:
        ScenarioError: `[contact]` asks for them or changes how, and the robot has neither contacts
            nor joint limits.
    """
    touches = bool(contacts.colliding(model).any())
    usual = ContactSection()
    changed = [
        (name, value)
        for name, value in scenario.contact
        if value != getattr(usual, name) and (name, value) != ("phases", False)
    ]
    if changed and not touches and not model.jnt_limited.any():
        name, value = changed[0]
        raise ScenarioError(
            f"contact.{name} is {json.dumps(value)}, but no two geoms of {scenario.model.path} may "
            "touch and no joint has a limit; leave it out"
        )
    wanted = scenario.contact.phases
    return touches or bool(changed) if wanted is None else wanted


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
            values[model.nv : 2 * model.nv] = np.where(held(model), REST, 1.0) * DEFAULT_DENSITY
            density = values.tolist()
        elif section.kind == "force":
            density = default_force_density(model).tolist()
        if section.matrix is None:
            what = {
                "additive": "every velocity, (unit)²/s",
                "force": "every velocity, (unit)²/s, as forces scaled by the robot's inertia",
            }
            assumed = what.get(section.kind, "every control, (unit)² s")
            if held(model).any():
                notices.append(note(model, space.names))
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


def default_force_density(model: mujoco.MjModel) -> Float[Array, " nv"]:
    """Density of forces under which each velocity gains `DEFAULT_DENSITY` (unit)²/s by its own.

    q = DEFAULT_DENSITY / ((M⁻¹)ᵢᵢ)², with M of the reference pose (MuJoCo's `dof_invweight0`), in
    (N or N m)² s: a constant density would throw a light robot and not move a heavy one.
    """
    inverse = np.asarray(model.dof_invweight0, np.float64)
    moves = (inverse > 0) & ~held(model)
    return np.where(moves, DEFAULT_DENSITY / np.where(moves, inverse, 1.0) ** 2, 0.0)


def note_defaults(scenario: Scenario, model: mujoco.MjModel, notices: list[str]) -> None:
    """Append a notice for each section that the scenario leaves out, with its default."""
    given = scenario.model_fields_set
    if scenario.model.keyframe is None:
        first = f"the first keyframe, '{model.key(0).name}'" if model.nkey else "qpos0 at rest"
        notices.append(f"no model.keyframe given; starting about {first}")
    if "initial" not in given:
        notices.append(f"no [initial] given; assuming a std of {default_number(model)} everywhere")
    if "control" not in given:
        notices.append("no [control] given; holding the nominal control")
    if "simulation" not in given:
        simulation = scenario.simulation
        notices.append(
            f"no [simulation] given; {simulation.runs} runs of {simulation.duration:g} s, "
            f"seed {simulation.seed}"
        )


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
