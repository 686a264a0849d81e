"""Tables of usual sensors: encoders, an IMU, fixes; and those of a robot that declares none."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np

from estbench.errors import ScenarioError, did_you_mean
from estbench.robots.added_sensors import object_names
from estbench.robots.layout import BALL, FREE, SLIDE
from estbench.sensors.channel import Channel
from estbench.sensors.datasheet import DEFAULT_NOISE

Table = dict[str, dict[str, Any]]
"""Channel -> settings of `[channels.NAME]`."""
_MANY = {
    "encoder": "joint encoders", "position": "positions", "attitude": "attitudes", "gyro": "gyros",
}  # fmt: skip


def encoders(model: mujoco.MjModel, pattern: str = "*", noise: float | None = None) -> Table:
    """A position encoder on every hinge, slide and ball joint whose name matches.

    Args:
        model: compiled MuJoCo model, e.g. `env.unwrapped.model`.
        pattern: glob pattern of joint names.
        noise: standard deviation, rad or m; default by unit.

    Raises:
        ScenarioError: the pattern matches no such joint.
    """
    names = object_names(model, "joint")
    joints = {n: kind for n, kind in zip(names, model.jnt_type) if kind != FREE}
    table: Table = {}
    for name, kind in joints.items():
        if fnmatchcase(name, pattern):
            sensor = "ballquat" if kind == BALL else "jointpos"
            table[f"{name}_encoder"] = _entry(sensor, name, "joint", noise)
    if not table and pattern != "*":
        raise ScenarioError(
            f"encoders: '{pattern}' matches no hinge, slide or ball joint"
            f"{did_you_mean(pattern, joints)}"
        )
    return table


def imu(body: str, gyro: float | None = None, accel: float | None = None) -> Table:
    """A gyro (rad/s) and an accelerometer (m/s²) at the origin of a body, with these std."""
    return {
        f"{body}_gyro": _entry("gyro", body, "xbody", gyro),
        f"{body}_accel": _entry("accelerometer", body, "xbody", accel),
    }


def position_fix(body: str, noise: float | None = None, rate: float | None = None) -> Table:
    """The position of a body's origin in the world (m), at a rate (Hz; default every step)."""
    entry = _entry("framepos", body, "xbody", noise)
    return {f"{body}_position": entry if rate is None else {**entry, "rate": rate}}


def attitude_fix(body: str, noise: float | None = None, rate: float | None = None) -> Table:
    """The attitude of a body (quaternion; noise in rad per axis), at a rate (Hz)."""
    entry = _entry("framequat", body, "xbody", noise)
    return {f"{body}_attitude": entry if rate is None else {**entry, "rate": rate}}


def default(model: mujoco.MjModel) -> Table:
    """An encoder on every joint; pose and gyro on every free body; noise that fits the units."""
    slides = np.array(object_names(model, "joint"))[model.jnt_type == SLIDE]
    table = {
        name: {**entry, "noise": DEFAULT_NOISE["m" if entry["add"]["object"] in slides else "rad"]}
        for name, entry in encoders(model).items()
    }
    bodies = object_names(model, "body")
    for joint in np.flatnonzero(model.jnt_type == FREE):
        body = bodies[model.jnt_bodyid[joint]]
        table |= position_fix(body, DEFAULT_NOISE["m"])
        table |= attitude_fix(body, DEFAULT_NOISE["rad"])
        table[f"{body}_gyro"] = _entry("gyro", body, "xbody", DEFAULT_NOISE["rad/s"])
    return table


def summary(channels: Sequence[Channel]) -> str:
    """Channels of `default` in a few words, those alike as one: `8 joint encoders (0.01 rad)`."""
    alike: dict[tuple[str, str], list[str]] = {}
    for channel in channels:
        kind = channel.name.rpartition("_")[2]
        noise = f"{np.sqrt(channel.cov[0, 0]):g} {channel.space.units[0]}"
        alike.setdefault((kind, noise), []).append(channel.name)
    return ", ".join(
        f"{names[0] if len(names) == 1 else f'{len(names)} {_MANY[kind]}'} ({noise})"
        for (kind, noise), names in alike.items()
    )


def _entry(sensor: str, name: str, kind: str, noise: float | None) -> dict[str, Any]:
    entry: dict[str, Any] = {"add": {"type": sensor, "object": name, "object_type": kind}}
    return entry if noise is None else {**entry, "noise": noise}
