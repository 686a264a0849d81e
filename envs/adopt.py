"""A Gymnasium environment's MuJoCo model as a filter may use it: a copy, with sensors added."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from estbench.envs import sensors as kits
from estbench.errors import ScenarioError
from estbench.robots.extended import with_sensors
from estbench.robots.flags import set_flags
from estbench.robots.model import Scale, SensorChannel
from estbench.sensors import channel as channels_of
from estbench.sensors import kit
from estbench.sensors.channel import Channel


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


def adopt(
    model: mujoco.MjModel,
    sensors: str | Path | Sequence[str] | Mapping[str, Any] | None,
    frame_skip: int,
) -> Adopted:
    """An environment's compiled model with the sensors asked for; the model is not changed.

    Args:
        model: of the environment.
        sensors: see `estbench.envs.sensors.sections`.
        frame_skip: physics steps of a step.

    Raises:
        ScenarioError: a sensor names nothing in the model, or a setting is wrong.
    """
    sections, use, assumed_kit = kits.sections(sensors, model)
    # The environment is exact about its sensors, but R must be positive definite: a channel
    # declared without noise is read without noise, and trusted as much as a usual one.
    exact = frozenset(name for name, s in sections.items() if s.noise == 0.0)
    sections = {
        name: s.model_copy(update={"noise": None}) if name in exact else s
        for name, s in sections.items()
    }
    added = {name: s.add for name, s in sections.items() if s.add is not None}
    copied = _plain(with_sensors(model, added, "the model") if added else copy.copy(model))
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


def _plain(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model, with estbench's flags and its sensors without delay and interval."""
    if model.nu and (np.asarray(model.actuator_history)[:, 0] > 0).any():
        raise ScenarioError(
            "an actuator has nsample > 0: its delay is a hidden state that no estimator sees"
        )
    if model.nsensor:
        model.sensor_history[:], model.sensor_delay[:], model.sensor_interval[:] = 0, 0.0, 0.0
    set_flags(model)
    return model
