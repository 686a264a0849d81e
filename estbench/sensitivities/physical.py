"""The parameters of a compiled robot whose values a sensitivity varies: masses, damping, ..."""

from collections.abc import Iterator

import mujoco
import numpy as np

from estbench.robots import contacts
from estbench.robots import parameters as named

_JOINT = {
    "dof_damping": ("N s/m", "N m s/rad"), "dof_frictionloss": ("N", "N m"),
    "dof_armature": ("kg", "kg m²"), "jnt_stiffness": ("N/m", "N m/rad"),
}  # fmt: skip
"""Field -> unit for a slide joint, and for the others."""
_OTHER = {
    "body_mass": "kg", "body_inertia": "kg m²", "actuator_gear": "", "tendon_stiffness": "N/m",
    "tendon_damping": "N s/m", "geom_friction": "",
}  # fmt: skip
_KINDS = {
    "body": mujoco.mjtObj.mjOBJ_BODY, "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT, "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR, "tendon": mujoco.mjtObj.mjOBJ_TENDON,
}  # fmt: skip


def parameters_of(model: mujoco.MjModel, field: str) -> Iterator[str]:
    """The named objects that have a field, and on which it has an effect."""
    prefix = field.split("_")[0]
    counts = {"body": model.nbody, "geom": model.ngeom, "jnt": model.njnt, "dof": model.njnt,
              "actuator": model.nu, "tendon": model.ntendon}  # fmt: skip
    moved = model.body_dofnum[model.body_weldid] > 0
    touching = contacts.colliding(model)[model.geom_bodyid] & (model.geom_contype > 0)
    for i in range(counts[prefix]):
        name = mujoco.mj_id2name(model, _KINDS[prefix], i)
        idle = (prefix == "body" and not moved[i]) or (prefix == "geom" and not touching[i])
        if name and not idle:
            yield f"{field}.{name}"


def parameters(model: mujoco.MjModel) -> Iterator[tuple[str, float | list[float], str]]:
    """`field.object`, value and unit of each parameter that is not zero."""
    for field in (*_OTHER, *_JOINT):
        for key in parameters_of(model, field):
            _, rows = named.parameter(model, key, "sensitivity")
            value = np.asarray(getattr(model, field)[rows], np.float64)
            if value.any():
                yield key, _plain(value), _unit(model, field, key)


def _plain(value: np.ndarray) -> float | list[float]:
    """One number where all are the same."""
    flat = value.ravel()
    return float(flat[0]) if (flat == flat[0]).all() else flat.tolist()


def _unit(model: mujoco.MjModel, field: str, key: str) -> str:
    if field in _OTHER:
        return _OTHER[field]
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, key.partition(".")[2])
    return _JOINT[field][model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_SLIDE]
