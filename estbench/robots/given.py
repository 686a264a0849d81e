"""What a robot is given from outside: controls, and, where others are in use, all inputs.

The known input u of a MuJoCo model has one of two widths. `(..., nu)`: controls alone; mocap bodies
are at rest, no force is applied, and the parameters are the model's own. Or
`(..., size + 1)`: MuJoCo's user inputs (controls, applied generalized and Cartesian forces, active
equality constraints, poses of mocap bodies, user data; `mjSTATE_USER`), and the number of the model
that has the parameters (`Backend.follow`), 0 for the model itself.
"""

import mujoco
import numpy as np

from estbench.shapes import Array, Float

INPUTS = int(mujoco.mjtState.mjSTATE_USER)
"""MuJoCo's signature of all inputs."""
STATE = int(
    mujoco.mjtState.mjSTATE_TIME
    | mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_ACT
)
"""MuJoCo's signature of time, qpos, qvel and act, which come before the inputs."""
_NAMED = {
    "controls": mujoco.mjtState.mjSTATE_CTRL,
    "qfrc_applied": mujoco.mjtState.mjSTATE_QFRC_APPLIED,
    "xfrc_applied": mujoco.mjtState.mjSTATE_XFRC_APPLIED,
    "eq_active": mujoco.mjtState.mjSTATE_EQ_ACTIVE,
    "mocap_pos": mujoco.mjtState.mjSTATE_MOCAP_POS,
    "mocap_quat": mujoco.mjtState.mjSTATE_MOCAP_QUAT,
    "userdata": mujoco.mjtState.mjSTATE_USERDATA,
}


def size(model: mujoco.MjModel) -> int:
    """Number of inputs."""
    return mujoco.mj_stateSize(model, INPUTS)


def columns(model: mujoco.MjModel) -> dict[str, slice]:
    """Where each kind of input is in u."""
    out, start = {}, 0
    for name, kind in _NAMED.items():
        stop = start + mujoco.mj_stateSize(model, int(kind))
        out[name], start = slice(start, stop), stop
    return out


def at_rest(model: mujoco.MjModel) -> Float[Array, " inputs"]:
    """The inputs of a robot that nobody touches.

    Mocap bodies are where the first keyframe puts them; without a keyframe, where the bodies are.
    """
    out, data = np.empty(size(model)), mujoco.MjData(model)
    if model.nkey and model.nmocap:
        data.mocap_pos[:] = np.reshape(model.key_mpos[0], (-1, 3))
        data.mocap_quat[:] = np.reshape(model.key_mquat[0], (-1, 4))
    mujoco.mj_getState(model, data, out, INPUTS)
    return out


def rest_as(model: mujoco.MjModel, other: mujoco.MjModel, keyframe: int) -> None:
    """Let the mocap bodies of a model rest where a keyframe of another, or the same, puts them.

    Its poses become those of the first keyframe. The poses of the bodies themselves are left alone:
    MuJoCo derives the constants of equality constraints from them.
    """
    if model.nmocap == other.nmocap and model.nkey and other.nkey:
        model.key_mpos[0], model.key_mquat[0] = other.key_mpos[keyframe], other.key_mquat[keyframe]


def mocap_names(model: mujoco.MjModel) -> list[str]:
    """Names of the mocap bodies."""
    return [
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i) or f"body{i}"
        for i in np.flatnonzero(np.asarray(model.body_mocapid) >= 0).tolist()
    ]
