"""A Gymnasium environment's MuJoCo model as a filter may use it: a copy, with sensors added."""

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from estbench.envs import sensors as kits
from estbench.envs.errors import EnvError
from estbench.errors import ScenarioError
from estbench.robots import added_sensors, mjcf
from estbench.robots.flags import set_flags
from estbench.robots.library import engine
from estbench.robots.model import Scale, SensorChannel
from estbench.robots.parameters import SETTINGS
from estbench.sensors import channel as channels_of
from estbench.sensors import kit
from estbench.sensors.channel import Channel

_BAD_STATE = tuple(
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")
)


@dataclass(frozen=True, eq=False)
class Adopted:
    """An environment's model with sensors.

    Attributes:
        model: a copy that holds the sensors, with estbench's flags (see `models.mjcf`).
        channels: sensors in use, as they are.
        believed: as a filter believes them.
        notices: what was assumed.
    """

    model: mujoco.MjModel
    channels: tuple[Channel, ...]
    believed: tuple[SensorChannel, ...]
    notices: tuple[str, ...]


def mujoco_parts(env: Any) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """`model` and `data` of an environment.

    Raises:
        EnvError: it has none.
    """
    base = env.unwrapped
    model: Any = getattr(base, "model", None)
    data: Any = getattr(base, "data", None)
    if not (isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData)):
        raise EnvError(
            f"{type(base).__name__} is not a MuJoCo environment: its unwrapped needs a `model` "
            "(mujoco.MjModel) and a `data` (mujoco.MjData); for a robot of your own use "
            "gym.make('estbench/Scenario-v0', scenario='robot.toml')"
        )
    if not model.nv:
        raise EnvError(f"{type(base).__name__}: its model has no joint, so there is no state")
    return model, data


def adopt(
    env: Any,
    sensors: str | Path | Sequence[str] | Mapping[str, Any] | None,
    xml: str | Path | None,
    frame_skip: int,
) -> Adopted:
    """The environment's model with the sensors asked for; the environment is not changed.

    Args:
        env: a MuJoCo environment.
        sensors: see `estbench.envs.sensors.sections`.
        xml: MJCF file of the model; default the environment's own `fullpath`. It is needed only
            to add sensors.
        frame_skip: physics steps of a step.

    Raises:
        EnvError: sensors are to be added, but there is no MJCF, or it is not of this model.
        ScenarioError: a sensor names nothing in the model, or a setting is wrong.
    """
    model, _ = mujoco_parts(env)
    sections, use, assumed_kit = kits.sections(sensors, model)
    # The environment is exact about its sensors, but R must be positive definite: a channel
    # declared without noise is read without noise, and trusted as much as a usual one.
    exact = frozenset(name for name, s in sections.items() if s.noise == 0.0)
    sections = {
        name: s.model_copy(update={"noise": None}) if name in exact else s
        for name, s in sections.items()
    }
    added = {name: s.add for name, s in sections.items() if s.add is not None}
    copied = _with_sensors(model, added, _file(env, xml)) if added else _bare_copy(model)
    channels, assumed = channels_of.build(copied, sections, use, frame_skip)
    for channel in channels:
        period, first = channel.timing.period, channel.timing.phase or channel.timing.period
        if period % frame_skip or first % frame_skip:
            rate = 1 / (frame_skip * model.opt.timestep)
            raise ScenarioError(
                f"sensors.{channel.name}.rate: a reading every {period} physics steps, the first "
                f"after {first}, falls inside a step of the environment ({frame_skip}); use a rate "
                f"of {rate:g} Hz over a whole number"
            )
    if assumed_kit:
        assumed.append(f"no sensors given and none in the model; using {kit.summary(channels)}")
    believed = [SensorChannel(c.name, -1, c.cov, _scale(c), c.measurand) for c in channels]
    true = [
        replace(c, cov=np.zeros_like(c.cov), schedule=None) if c.name in exact else c
        for c in channels
    ]
    return Adopted(copied, tuple(true), tuple(believed), tuple(assumed))


def _scale(channel: Channel) -> Scale | None:
    return None if channel.schedule is None else channel.schedule.at


def check_not_reset(data: mujoco.MjData) -> None:
    """Raise if MuJoCo has reset a state that was not finite or too large.

    In the first step of an episode `data.time` does not show it.

    Raises:
        EnvError: it has.
    """
    if any(data.warning[kind].number for kind in _BAD_STATE):
        raise EnvError(
            "MuJoCo reset the state in this step, since it was not finite or too large; the "
            "episode is void: call reset()"
        )


def _file(env: Any, xml: str | Path | None) -> str:
    path = xml if xml is not None else getattr(env.unwrapped, "fullpath", None)
    if path is None:
        raise EnvError(
            f"{type(env.unwrapped).__name__} does not say which MJCF it was made from, so "
            "no sensor can be added; pass xml='path/to/model.xml', or use sensors that the model "
            "declares"
        )
    return str(path)


def _with_sensors(model: mujoco.MjModel, added: Mapping[str, Any], path: str) -> mujoco.MjModel:
    """Compile the MJCF with sensors, then give it every parameter of the environment's model."""
    _check_objects(model, added)
    spec = mjcf.read(path)
    # What the compiler has to say of this MJCF it said when the environment was made.
    with warnings.catch_warnings(action="ignore", category=UserWarning), engine():
        added_sensors.add(spec, added, Path(path).name, "sensors.{}")
        compiled = mjcf.compile_model(spec, where="sensors")
    for size in ("nq", "nv", "na", "nu", "nbody", "ngeom", "njnt"):
        if getattr(compiled, size) != getattr(model, size):
            raise EnvError(
                f"{path} has {size} = {getattr(compiled, size)} and the environment's model "
                f"{getattr(model, size)}: the environment changed its MJCF; pass the changed one "
                "as xml=..., or declare the sensors in it"
            )
    _copy_parameters(model, compiled)
    return compiled


def _bare_copy(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy with estbench's flags, its sensors without delay and interval."""
    out = copy.copy(model)
    if model.nu and (np.asarray(model.actuator_history)[:, 0] > 0).any():
        raise ScenarioError(
            "an actuator has nsample > 0: its delay is a hidden state that no estimator sees"
        )
    if model.nsensor:
        out.sensor_history[:], out.sensor_delay[:], out.sensor_interval[:] = 0, 0.0, 0.0
    set_flags(out)
    return out


def _copy_parameters(source: mujoco.MjModel, target: mujoco.MjModel) -> None:
    """Every number that may have been set on the compiled model: masses, gains, options, ..."""
    for name in dir(source):
        value = getattr(source, name) if not name.startswith("_") else None
        if not isinstance(value, np.ndarray) or name.startswith(("sensor_", "site_", "name_")):
            continue
        there = getattr(target, name)
        if there.shape == value.shape and (value.dtype.kind == "f" or SETTINGS.search(name)):
            there[...] = value
    for name in dir(source.opt):
        if not name.startswith("_"):
            value = getattr(source.opt, name)
            if isinstance(value, np.ndarray):
                getattr(target.opt, name)[...] = value
            elif not callable(value):
                setattr(target.opt, name, value)
    set_flags(target)


def _check_objects(model: mujoco.MjModel, sensors: Mapping[str, Any]) -> None:
    """Raise where a sensor is to be added at a joint, body or site that is not there."""
    names = {kind: added_sensors.object_names(model, kind) for kind in ("joint", "body", "site")}
    for name, sensor in sensors.items():
        added_sensors.check_object(sensor, names, f"sensors.{name}.object")
