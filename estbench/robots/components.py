"""Sensors that read components of the state: encoders, tachometers, the pose of a free body.

Their reading needs no call of MuJoCo, and their Jacobian H consists of rows of the identity. Of a
free joint qpos is the pose of its body, and qvel the velocity of the origin in the world and the
angular velocity in the body's frame.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.robots.layout import FREE
from estbench.shapes import Array

_TYPES, _KINDS = mujoco.mjtSensor, mujoco.mjtObj
_OF_JOINTS = {
    _TYPES.mjSENS_JOINTPOS: 0, _TYPES.mjSENS_BALLQUAT: 0,
    _TYPES.mjSENS_JOINTVEL: 1, _TYPES.mjSENS_BALLANGVEL: 1,
}  # fmt: skip
"""Type of a sensor at a joint -> 0 for its position, 1 for its velocity."""
_OF_BODIES = {
    _TYPES.mjSENS_FRAMEPOS: (0, 0), _TYPES.mjSENS_FRAMEQUAT: (0, 3),
    _TYPES.mjSENS_FRAMELINVEL: (1, 0), _TYPES.mjSENS_GYRO: (1, 3),
}  # fmt: skip
"""Type of a sensor at a free body -> the same, and its first coordinate of the joint's six."""


def components(
    model: mujoco.MjModel, sensors: Sequence[int], columns: NDArray[np.intp]
) -> tuple[NDArray[np.intp], Array] | None:
    """Where the state holds the readings of sensors.

    Args:
        model: compiled.
        sensors: their indices.
        columns: those of `sensordata` that are read; of a quaternion all four.

    Returns:
        Of each column the index in the state `(ny,)`, and H `(m, n)`; None where a reading is not
        a component of the state.
    """
    points, tangents = dict[int, int](), dict[int, int]()
    for sensor in sensors:
        start = _start(model, sensor)
        if start is None or model.sensor_cutoff[sensor] > 0:
            return None
        for k in range(model.sensor_dim[sensor]):
            column = int(model.sensor_adr[sensor]) + k
            points[column] = start[0] + k
            if k < 3:  # a quaternion has three coordinates
                tangents[column] = start[1] + k
    rows = [tangents[c] for c in columns.tolist() if c in tangents]
    point = np.array([points[c] for c in columns.tolist()], np.intp)
    return point, np.eye(2 * model.nv + model.na)[rows]


def _start(model: mujoco.MjModel, sensor: int) -> tuple[int, int] | None:
    """The first index of a sensor's reading in the state and in its tangent, if it has one."""
    kind, at = _TYPES(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    if kind in _OF_JOINTS:
        joint, speed, part = at, _OF_JOINTS[kind], 0
    elif kind in _OF_BODIES and model.sensor_refid[sensor] < 0:
        joint = _free_joint(model, int(model.sensor_objtype[sensor]), at)
        if joint is None:
            return None
        speed, part = _OF_BODIES[kind]
    else:
        return None
    dof = int(model.jnt_dofadr[joint]) + part
    if speed:
        return model.nq + dof, model.nv + dof
    return int(model.jnt_qposadr[joint]) + part, dof


def _free_joint(model: mujoco.MjModel, kind: int, index: int) -> int | None:
    """The free joint of the body whose frame is that of an object, if there is one."""
    body = index
    if kind == int(_KINDS.mjOBJ_SITE):
        body = int(model.site_bodyid[index])
        if model.site_pos[index].any() or model.site_quat[index, 1:].any():
            return None
    elif kind != int(_KINDS.mjOBJ_XBODY):
        return None
    joint = int(model.body_jntadr[body])
    return joint if joint >= 0 and model.jnt_type[joint] == FREE else None
