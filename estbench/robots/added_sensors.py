"""Sensors that a scenario or an environment adds to a robot; the MJCF file is not changed."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco

from estbench.errors import ScenarioError, did_you_mean
from estbench.robots.compiling import compiled

SENSOR_TYPES = {
    name.removeprefix("mjSENS_").lower(): getattr(mujoco.mjtSensor, name)
    for name in dir(mujoco.mjtSensor)
    if name.startswith("mjSENS_")
}
# Kind of object that a sensor type is attached to, if it is not a site.
_OBJECTS = {
    "joint": "joint",
    "ball": "joint",
    "tendon": "tendon",
    "actuator": "actuator",
    "subtree": "body",
}
# Types that MuJoCo attaches to a site only.
_AT_SITES = (
    "gyro", "accelerometer", "velocimeter", "magnetometer", "force", "torque", "touch",
    "rangefinder",
)  # fmt: skip
_COUNTS = {
    "joint": "njnt", "body": "nbody", "site": "nsite", "geom": "ngeom", "camera": "ncam",
    "tendon": "ntendon", "actuator": "nactuator",
}  # fmt: skip
KINDS = tuple(_COUNTS)
"""Kinds of objects that sensors are attached to and that may have no name."""
# Types without an object, or with one of any kind.
_FREE = ("clock", "e_potential", "e_kinetic", "user", "plugin")


def object_kind(sensor: Any) -> str:
    """Kind of the object that a sensor (see `sections.AddSensor`) is attached to."""
    guess = (o for prefix, o in _OBJECTS.items() if sensor.type.startswith(prefix))
    return sensor.object_type or next(guess, "site")


def object_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of the objects of a kind in their order; `joint3` for one without a name.

    Raises:
        ScenarioError: no such kind.
    """
    if kind not in _COUNTS:
        hint = did_you_mean(kind, _COUNTS) or f"; use {', '.join(_COUNTS)}"
        raise ScenarioError(f"no object type '{kind}' that has several objects{hint}")
    enum = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    count = getattr(model, _COUNTS[kind])
    return _named([mujoco.mj_id2name(model, enum, i) or "" for i in range(count)], kind)


def _named(names: Sequence[str], kind: str) -> list[str]:
    """The names, with kind and index for each empty one; `_` is appended to a name in use."""
    taken, out = set(names), []
    for index, given in enumerate(names):
        name = given or f"{kind}{index}"
        while not given and name in taken:
            name += "_"
        out.append(name)
    return out


def name_objects(spec: mujoco.MjSpec) -> None:
    """Give the objects without a name the one of `object_names`.

    Raises:
        ValueError: the description does not compile.
    """
    listed = {
        "joint": spec.joints, "body": spec.bodies, "site": spec.sites, "geom": spec.geoms,
        "camera": spec.cameras, "tendon": spec.tendons, "actuator": spec.actuators,
    }  # fmt: skip
    if all(element.name for elements in listed.values() for element in elements):
        return
    compiled(spec)  # their order is known after it
    for kind, elements in listed.items():
        ordered = sorted(elements, key=lambda element: element.id)
        for element, name in zip(ordered, _named([e.name for e in ordered], kind)):
            if not element.name:
                element.name = name


def check_object(
    sensor: Any, names: Mapping[str, Sequence[str]], where: str, robot: str = "the model"
) -> None:
    """Refuse a sensor at an object that does not exist.

    Args:
        sensor: see `sections.AddSensor`.
        names: kind of object -> names of the existing objects; MuJoCo checks other kinds.
        where: the setting that names the object.
        robot: the owner of the objects, for the message.

    Raises:
        ScenarioError: the object does not exist; the message lists those that do.
    """
    kind = object_kind(sensor).removeprefix("x")  # an xbody is a body
    if sensor.type in _FREE or kind not in names or sensor.object in names[kind]:
        return
    there = [name for name in names[kind] if name]
    others = [other for other, known in names.items() if sensor.object and sensor.object in known]
    if others and sensor.type.startswith("frame"):  # of a body, a geom, a site, ...
        hint = f" but a {others[0]} of this name: give object_type = '{others[0]}'"
    else:
        hint = did_you_mean(sensor.object, there) or f", nor any other {kind} with a name"
    raise ScenarioError(f"{where}: {robot} has no {kind} '{sensor.object}'{hint}")


def add(
    spec: mujoco.MjSpec, sensors: Mapping[str, Any], robot: str, where: str = "channels.{}.add"
) -> None:
    """Add sensors to a robot's description.

    Args:
        spec: the description; it is changed.
        sensors: name -> object with `type`, `object`, `object_type` (see `sections.AddSensor`).
        robot: name of the robot, for messages.
        where: the setting that adds the sensor, with `{}` for its name, for messages.

    Raises:
        ScenarioError: a sensor's type or object is unknown, or its name is taken.
    """
    if not sensors:
        return
    name_objects(spec)
    declared = [sensor.name for sensor in spec.sensors]
    names = {
        "joint": [joint.name for joint in spec.joints],
        "body": [body.name for body in spec.bodies],
        "site": [site.name for site in spec.sites],
    }
    for name, sensor in sensors.items():
        here = where.format(name)
        if name in declared:
            raise ScenarioError(
                f"{here}: {robot} has a sensor '{name}' already; to use that one leave `add` out, "
                "for a second one choose another name"
            )
        if sensor.type not in SENSOR_TYPES:
            hint = did_you_mean(sensor.type, SENSOR_TYPES)
            raise ScenarioError(f"{here}.type: no sensor type '{sensor.type}'{hint}")
        kind = object_kind(sensor)
        objtype = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}", None)
        if objtype is None:
            raise ScenarioError(
                f"{here}.object_type: no object type '{kind}'; use joint, site, ..."
            )
        check_object(sensor, names, f"{here}.object", robot)
        attached = {"objtype": objtype, "objname": sensor.object} if sensor.object else {}
        if sensor.type in _AT_SITES and kind in ("body", "xbody"):
            attached = {"objtype": mujoco.mjtObj.mjOBJ_SITE, "objname": _site(spec, sensor.object)}
        spec.add_sensor(name=name, type=SENSOR_TYPES[sensor.type], **attached)


def _site(spec: mujoco.MjSpec, body: str) -> str:
    """Name of a site at the origin of a body, made on first use."""
    name = f"estbench:{body}"
    if spec.site(name) is None:
        spec.body(body).add_site(name=name)
    return name
