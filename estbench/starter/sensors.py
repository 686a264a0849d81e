"""The channels of a first scenario: those of the MJCF, and the usual ones that it lacks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import ScenarioError, did_you_mean
from estbench.robots import layout
from estbench.robots.added_sensors import object_names
from estbench.sensors.datasheet import DEFAULT_NOISE, FALLBACK_NOISE
from estbench.starter.robot import Robot

KINDS = ("encoders", "position", "imu")
"""Groups of sensors that may be added, in the order in which they are tried."""
MOST = 100
"""Values of one reading; a sensor with more is declared and left out."""
_OUTSIDE = ("user", "plugin", "clock", "e_potential", "e_kinetic", "tactile", "contact")
"""Types whose reading is no measurement of the state, or none that a filter can predict."""


@dataclass(frozen=True)
class Entry:
    """One table `[channels.NAME]`.

    Attributes:
        name: of the channel, or the ending of the names of several.
        kind: MuJoCo's type.
        unit: of the reading.
        noise: std; None: the MJCF has it.
        objects: what it is added to; empty for a sensor of the MJCF.
        object_type: joint or xbody.
        used: whether the channel is on.
    """

    name: str
    kind: str
    unit: str
    noise: float | None
    objects: tuple[str, ...] = ()
    object_type: str = ""
    used: bool = True


def asked(text: str | None) -> tuple[str, ...] | None:
    """The groups of `--sensors`, a list with commas; None without one.

    Raises:
        ScenarioError: there is no such group.
    """
    if text is None:
        return None
    groups = tuple(part.strip() for part in text.split(",") if part.strip())
    for group in groups:
        if group not in KINDS:
            hint = did_you_mean(group, KINDS) or f"; use {', '.join(KINDS)}"
            raise ScenarioError(f"--sensors has '{group}'{hint}")
    return groups


def own(robot: Robot) -> list[Entry]:
    """The sensors of the MJCF."""
    model = robot.model
    entries = []
    for i in range(model.nsensor):
        kind, unit = layout.sensor_type(model, i), layout.sensor_unit(model, i)
        noise = None if model.sensor_noise[i] > 0 else DEFAULT_NOISE.get(unit, FALLBACK_NOISE)
        used = kind not in _OUTSIDE and model.sensor_dim[i] <= MOST
        entries.append(Entry(layout.sensor_name(model, i), kind, unit, noise, used=used))
    return entries


def missing(robot: Robot, group: str, taken: Sequence[str]) -> list[Entry]:
    """The sensors of a group that the MJCF does not have; their names are none of `taken`."""
    entries = {"encoders": _encoders, "position": _pose, "imu": _imu}[group](robot)
    return [e if e.name not in taken else _renamed(e, taken) for e in entries]


def _renamed(entry: Entry, taken: Sequence[str]) -> Entry:
    name = entry.name
    while name in taken:
        name += "_added"
    return Entry(name, entry.kind, entry.unit, entry.noise, entry.objects, entry.object_type)


def _measured(robot: Robot, kinds: Sequence[str]) -> set[int]:
    """The joints, or the bodies, that the MJCF's sensors of these types are attached to."""
    model, found = robot.model, set()
    for i in range(model.nsensor):
        if layout.sensor_type(model, i) in kinds:
            index = int(model.sensor_objid[i])
            at_site = model.sensor_objtype[i] == 6  # mjOBJ_SITE
            found.add(int(model.site_bodyid[index]) if at_site else index)
    return found


def _encoders(robot: Robot) -> list[Entry]:
    """One table for all hinges, one for all slides, one for all balls."""
    model = robot.model
    names = object_names(model, "joint")
    measured = _measured(robot, ("jointpos", "ballquat"))
    entries = []
    for name, joint, kind, unit in (
        ("encoder", layout.HINGE, "jointpos", "rad"),
        ("linear_encoder", layout.SLIDE, "jointpos", "m"),
        ("ball_encoder", layout.BALL, "ballquat", "rad"),
    ):
        joints = [
            names[j] for j in np.flatnonzero(model.jnt_type == joint).tolist() if j not in measured
        ]
        if joints:
            label = name if len(joints) > 1 else f"{joints[0]}_{name}"
            entries.append(Entry(label, kind, unit, DEFAULT_NOISE[unit], tuple(joints), "joint"))
    return entries


def _pose(robot: Robot) -> list[Entry]:
    """Position and attitude of each floating body; of a robot without one, of its last link."""
    bodies = robot.free or (robot.base,)
    return _at(robot, bodies, (("position", "framepos", "m"), ("attitude", "framequat", "rad")))


def _imu(robot: Robot) -> list[Entry]:
    """A gyro and an accelerometer at the base."""
    return _at(
        robot, (robot.base,), (("gyro", "gyro", "rad/s"), ("accel", "accelerometer", "m/s²"))
    )


def _at(robot: Robot, bodies: Sequence[str], wanted: Sequence[tuple[str, str, str]]) -> list[Entry]:
    names = object_names(robot.model, "body")
    entries = []
    for name, kind, unit in wanted:
        measured = _measured(robot, (kind,))
        at = [body for body in bodies if names.index(body) not in measured]
        if at:
            label = name if len(at) > 1 else f"{at[0]}_{name}"
            entries.append(Entry(label, kind, unit, DEFAULT_NOISE[unit], tuple(at), "xbody"))
    return entries
