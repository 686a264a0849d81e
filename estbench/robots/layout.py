"""Names, units and manifolds of a MuJoCo model's state and sensors."""

from collections.abc import Sequence

import mujoco
import numpy as np

from estbench.robots.sensor_types import JOINT_UNITS, UNITS
from estbench.spaces.manifold import Manifold

FREE, BALL, SLIDE, HINGE = range(4)
_QUATERNION = int(mujoco.mjtDataType.mjDATATYPE_QUATERNION)

_AXES = ("x", "y", "z")


def object_name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int, prefix: str) -> str:
    """Name of an object; prefix and index if the MJCF gives none."""
    return mujoco.mj_id2name(model, kind, index) or f"{prefix}{index}"


def control_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Name of each control: the actuator's, with the input's where it has several, as in `o.qw`."""
    names: list[str] = []
    for i, actuator in enumerate(_actuators(model)):
        for k in range(model.actuator_ctrlnum[i]):
            part = mujoco.mj_actuatorInputName(model, i, k)
            names.append(f"{actuator}.{part}" if part else actuator)
    return tuple(names)


def _actuators(model: mujoco.MjModel) -> list[str]:
    kind = mujoco.mjtObj.mjOBJ_ACTUATOR
    return [object_name(model, kind, i, "actuator") for i in range(model.nactuator)]


def state_space(model: mujoco.MjModel) -> Manifold:
    """The manifold of x = (qpos, qvel, act).

    The coordinates of a hinge or slide joint J are `J` and `J.vel`; of a ball joint `J.rx` ... and
    `J.wx` ...; of a free joint `J.x` ... `J.rx` ... and `J.vx` ... `J.wx` .... An activation is
    `actuator.act`.
    """
    names: list[str] = [""] * (2 * model.nv + model.na)
    units: list[str] = list(names)
    quaternions = []
    for j in range(model.njnt):
        joint = object_name(model, mujoco.mjtObj.mjOBJ_JOINT, j, "joint")
        kind, dof, qpos = model.jnt_type[j], model.jnt_dofadr[j], model.jnt_qposadr[j]
        if kind in (SLIDE, HINGE):
            unit = "m" if kind == SLIDE else "rad"
            parts = [("", ".vel", unit)]
        else:
            linear = [(f".{a}", f".v{a}", "m") for a in _AXES] if kind == FREE else []
            parts = linear + [(f".r{a}", f".w{a}", "rad") for a in _AXES]
            quaternions.append([qpos + len(linear), dof + len(linear)])
        for k, (position, velocity, unit) in enumerate(parts):
            names[dof + k], units[dof + k] = joint + position, unit
            names[model.nv + dof + k] = joint + velocity
            units[model.nv + dof + k] = f"{unit}/s"
    for i, actuator in enumerate(_actuators(model)):
        for k in range(model.actuator_actnum[i]):
            index = 2 * model.nv + model.actuator_actadr[i] + k
            names[index] = f"{actuator}.act" + (str(k) if model.actuator_actnum[i] > 1 else "")
            units[index] = "1"
    return Manifold(tuple(names), tuple(units), np.array(quaternions, np.intp).reshape(-1, 2))


def state_names(space: Manifold) -> tuple[str, ...]:
    """Name of each number of a state: that of its coordinate, or J.qw, ..., J.qz."""
    names = list(space.names)
    for start in sorted(space.quaternions[:, 1].tolist(), reverse=True):
        joint = names[start].removesuffix(".rx")
        names[start : start + 3] = [f"{joint}.q{axis}" for axis in "wxyz"]
    return tuple(names)


def sensor_type(model: mujoco.MjModel, index: int) -> str:
    """MJCF name of a sensor's type, e.g. `jointpos`."""
    return mujoco.mjtSensor(model.sensor_type[index]).name.removeprefix("mjSENS_").lower()


def sensor_name(model: mujoco.MjModel, index: int) -> str:
    """Name of a sensor; type and index if the MJCF gives none."""
    return object_name(model, mujoco.mjtObj.mjOBJ_SENSOR, index, f"{sensor_type(model, index)}_")


def sensor_unit(model: mujoco.MjModel, index: int) -> str:
    """Unit of the tangent coordinates of a sensor."""
    kind = sensor_type(model, index)
    if kind in JOINT_UNITS:
        slide, hinge = JOINT_UNITS[kind]
        return slide if model.jnt_type[model.sensor_objid[index]] == SLIDE else hinge
    return UNITS.get(kind) or "1"


def suffixes(n: int) -> list[str]:
    """Suffixes of the names of the n components of one reading."""
    return [""] if n == 1 else [f".{a}" for a in _AXES] if n == 3 else [f".{k}" for k in range(n)]


def sensor_space(model: mujoco.MjModel, sensors: Sequence[int]) -> Manifold:
    """The manifold of the concatenated readings of several sensors."""
    names: list[str] = []
    units: list[str] = []
    quaternions = []
    start = 0
    for i in sensors:
        name, width = sensor_name(model, i), int(model.sensor_dim[i])
        quaternion = model.sensor_datatype[i] == _QUATERNION
        if quaternion:
            quaternions.append([start, len(names)])
        n = 3 if quaternion else width
        names += [name + s for s in suffixes(n)]
        units += [sensor_unit(model, i)] * n
        start += width
    return Manifold(tuple(names), tuple(units), np.array(quaternions, np.intp).reshape(-1, 2))
