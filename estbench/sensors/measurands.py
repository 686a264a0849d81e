"""What a channel reads: one sensor of the model, several together, or a user's function."""

from collections.abc import Sequence
from typing import cast

import mujoco
import numpy as np

from estbench import plugins as users
from estbench.errors import DimensionError, ScenarioError, user_error_location
from estbench.models.probe import probe_function, spread
from estbench.robots import layout
from estbench.robots.measurement import Measurand, StateFunction
from estbench.scenario.channels import ChannelSection
from estbench.spaces.manifold import Manifold


def build(
    name: str, section: ChannelSection, model: mujoco.MjModel, names: Sequence[str]
) -> tuple[Measurand, str]:
    """What a channel reads, and the type of its sensors or `function`.

    Args:
        name: name of the channel.
        section: the scenario's `[channels.NAME]`.
        model: the MuJoCo model with all sensors.
        names: names of the model's sensors, in order.

    Raises:
        ScenarioError: settings that exclude each other, or a function that cannot be called.
    """
    where = f"channels.{name}"
    given = [key for key in ("of", "function", "add") if getattr(section, key) is not None]
    if len(given) > 1:
        raise ScenarioError(f"{where} has {' and '.join(given)}; give one of them")
    for key in ("unit", "angles"):
        if getattr(section, key) is not None and section.function is None:
            raise ScenarioError(f"{where}.{key} is for a function; a sensor has its own")
    if section.axes is not None and section.function is not None:
        raise ScenarioError(
            f"{where}.axes is for sensors; let the function return what is measured"
        )
    if section.function is not None:
        return _function(name, section.function, section, model), "function"
    members = [name] if section.of is None else section.of
    if len(set(members)) < max(1, len(members)):
        raise ScenarioError(f"{where}.of is {section.of}; name each of its sensors once")
    indices = [names.index(member) for member in members]
    if section.axes is not None:
        space = layout.sensor_space(model, indices)
        if not space.flat:
            raise ScenarioError(f"{where}.axes: a quaternion has no single axes")
        distinct = len(set(section.axes)) == len(section.axes) > 0
        if not distinct or max(section.axes) >= space.n:
            raise ScenarioError(
                f"{where}.axes is {section.axes}; use some of 0 to {space.n - 1}, each once"
            )
    kinds = " + ".join(layout.sensor_type(model, i) for i in indices)
    return Measurand.of_sensors(model, *indices, axes=section.axes), kinds


def _function(name: str, target: str, section: ChannelSection, model: mujoco.MjModel) -> Measurand:
    """A user's function of the state; a call finds how many numbers it returns.

    Raises:
        ScenarioError: the function raises, or returns another shape for another batch shape.
        ModelError: it draws random numbers, mixes the runs, or changes its argument.
    """
    where = f"channels.{name}.function"
    called = cast(StateFunction, users.function(target, where))
    x = np.concatenate([model.qpos0, np.zeros(model.nv + model.na)])
    x, u = np.tile(x, (2, 1)), np.zeros((2, model.nu))
    try:
        width = np.shape(called(x, u, 0.0))[-1]
    except (Exception, SystemExit) as error:  # a user's function may raise anything
        raise ScenarioError(
            f"{where} raised for x of shape {x.shape}: {user_error_location(error)}; it is "
            "called as h(x, u, t) and returns (..., m)"
        ) from None
    suffixes = layout.suffixes(width)
    names, units = [name + s for s in suffixes], [section.unit or "1"] * width
    try:
        space = Manifold.euclidean(width, names, units, section.angles or ())
    except DimensionError as error:
        raise ScenarioError(f"channels.{name}.{error}") from None
    measurand = Measurand(space, function=called, name=where)
    states = layout.state_space(model)
    apart = spread(states, np.tile(x[:1], (3, 1)), np.tile(1e-4 * np.eye(states.n), (3, 1, 1)))
    probe_function(where, lambda p: measurand.call(p, np.zeros((3, model.nu)), 0.0), apart)
    measurand.call(x, u, 0.0)
    measurand.call(np.tile(x, (3, 1, 1)), u[:1].repeat(3, axis=0), 0.0)
    return measurand
