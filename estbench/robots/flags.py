"""MuJoCo's flags: those that every model gets, and those that leave out needless work."""

import copy
from collections.abc import Collection
from typing import Literal

import mujoco
import numpy as np

Use = Literal["step", "velocity", "acceleration"]
"""What a model is for: steps, or sensors up to the forward stage of that name."""


def set_flags(model: mujoco.MjModel) -> None:
    """Set the flags without which estbench's results would be wrong; the model is changed.

    - No warm start: a step is then a function of (x, u) alone.
    - No automatic reset: a state that is not finite or too large never becomes the default pose.
    - No clamping of controls inside MuJoCo: `controls.ControlRange.clamp` does it, before the
      actuator noise is added.
    - No energy flag: with it the energy sensors of a row read another row's energies.
    - No sleep: whether a body sleeps is not part of the state.
    """
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= (
        flags.mjDSBL_WARMSTART | flags.mjDSBL_AUTORESET | flags.mjDSBL_CLAMPCTRL
    )
    off = mujoco.mjtEnableBit.mjENBL_ENERGY | mujoco.mjtEnableBit.mjENBL_SLEEP
    model.opt.enableflags &= ~int(off)


def notes(spec: mujoco.MjSpec) -> list[str]:
    """One line for each flag of an MJCF that changes the robot when it is switched off here."""
    if spec.option.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        return ["the MJCF enables sleep; it is off here, so bodies at rest are computed too"]
    return []


def leave_out_sensors(model: mujoco.MjModel, used: Collection[int]) -> None:
    """Have MuJoCo compute the sensors in use only; the model is changed.

    MuJoCo computes every sensor of a stage: the thousands of values of a tactile sensor took most
    of the time of a reading of an accelerometer.
    """
    unused = [i for i in range(model.nsensor) if i not in used]
    model.sensor_needstage[unused] = int(mujoco.mjtStage.mjSTAGE_NONE)


# They depend on constraints, or may do so, at a stage before the constraint forces are known.
_CONTACT_SENSORS = [
    getattr(mujoco.mjtSensor, f"mjSENS_{name}")
    for name in (
        "JOINTLIMITPOS", "JOINTLIMITVEL", "TENDONLIMITPOS", "TENDONLIMITVEL", "CONTACT", "USER",
        "PLUGIN",
    )
]  # fmt: skip


def reduced(model: mujoco.MjModel, use: Use) -> mujoco.MjModel:
    """A copy that leaves out work which cannot change what it is used for, to the last bit.

    Left out are: the sensors, where none is read; collision detection, where no pair of geoms may
    collide or no sensor in use depends on it; the constraints, where there is moreover no limit, no
    equality and no friction loss. For a small robot this saves a quarter of a step.
    """
    flags = mujoco.mjtDisableBit
    skip = 0
    if use == "step" and not model.nplugin:
        skip |= int(flags.mjDSBL_SENSOR)
    unaffected = use == "velocity" and not np.isin(model.sensor_type, _CONTACT_SENSORS).any()
    groups = (model.geom_contype, model.geom_conaffinity)
    contype, conaffinity = (np.bitwise_or.reduce(g, initial=0) for g in groups)
    if unaffected or not (contype & conaffinity or model.npair or model.nflex):
        skip |= int(flags.mjDSBL_CONTACT)
        constraints = (
            model.jnt_limited, model.tendon_limited, model.dof_frictionloss,
            model.tendon_frictionloss, model.nplugin, model.neq,
        )  # fmt: skip
        if unaffected or not any(np.any(c) for c in constraints):
            skip |= int(flags.mjDSBL_CONSTRAINT)
    out = copy.copy(model)
    out.opt.disableflags |= skip
    return out
