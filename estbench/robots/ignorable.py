"""Coordinates that the motion of a robot does not depend on: where it stands on a level floor.

Moved along such a coordinate, a robot moves as before, from another place: the column of Φ is that
of the identity (a cyclic coordinate; Goldstein, Classical Mechanics, 3rd ed., sec. 2.6), and costs
no physics step. They are translations of the whole robot: of a free joint, and of the slides that
come first in a body that hangs from the world.
"""

import mujoco
import numpy as np

from estbench.shapes import Array, Bool, Float, Int, Mask
from estbench.spaces.rotation import matrix

LEVEL = 1e-12
"""Slope of a plane along a direction, below which the direction lies in it."""
_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_JOINTS = [int(t) for t in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)]
_SITE = int(mujoco.mjtTrn.mjTRN_SITE)


def ignorable(model: mujoco.MjModel) -> Int[np.ndarray, " k"]:
    """Tangent coordinates of the state with a column of Φ that is that of the identity.

    Few kinds of robots are looked at closely; of all others none is found: those of several trees,
    with equality constraints, tendons, flexes, plugins, or actuators between bodies and the world.

    Args:
        model: compiled.
    """
    none = np.zeros(0, np.intp)
    if model.ntree != 1 or model.neq or model.ntendon or model.nflex or model.nplugin:
        return none
    kinds, sites = model.actuator_trntype, model.actuator_trnid[:, 1]
    if not (np.isin(kinds, _JOINTS) | ((kinds == _SITE) & (sites < 0))).all():
        return none
    if any(
        (types == int(user)).any()
        for types, user in (
            (model.actuator_dyntype, mujoco.mjtDyn.mjDYN_USER),
            (model.actuator_gaintype, mujoco.mjtGain.mjGAIN_USER),
            (model.actuator_biastype, mujoco.mjtBias.mjBIAS_USER),
        )
    ):
        return none
    root = int(model.tree_bodyadr[0])
    if model.body_parentid[root]:
        return none
    slopes, found = _slopes(model), list[int]()
    first = int(model.body_jntadr[root])
    for joint in range(first, first + int(model.body_jntnum[root])):
        kind, dof = int(model.jnt_type[joint]), int(model.jnt_dofadr[joint])
        if kind == _FREE:
            directions = np.eye(3)
        elif kind == _SLIDE:
            directions = (matrix(model.body_quat[root]) @ model.jnt_axis[joint])[None]
        else:
            break  # what comes after a hinge moves in a frame that turns
        if _bound(model, joint):
            continue
        level = (np.abs(directions @ slopes.T) < LEVEL).all(axis=1)
        found += (dof + np.flatnonzero(level)).tolist()
    return np.array(found, np.intp)


def _bound(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a force on a joint depends on its position."""
    driven = np.isin(model.actuator_trntype, _JOINTS) & (model.actuator_trnid[:, 0] == joint)
    simple = (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)) & (
        model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE)
    )
    springs = (model.jnt_stiffness[joint], model.jnt_stiffnesspoly[joint])
    return bool(
        model.jnt_limited[joint]
        or any(np.any(spring) for spring in springs)
        or (driven & ~simple).any()
    )


def _slopes(model: mujoco.MjModel) -> Float[Array, "k 3"]:
    """Normals of the planes of the world that may be touched; all directions where others may."""
    fixed = np.flatnonzero(_touched(model) & (model.geom_bodyid == 0))
    moved = np.flatnonzero(_touched(model) & (model.geom_bodyid > 0))
    tree = model.body_treeid[model.geom_bodyid[moved]]
    plane = model.geom_type[fixed] == int(mujoco.mjtGeom.mjGEOM_PLANE)
    if not plane.all() or (tree < 0).any():  # a plane has no end, whatever its size
        return np.eye(3)
    return matrix(model.geom_quat[fixed])[..., 2].reshape(-1, 3)


def _touched(model: mujoco.MjModel) -> Bool[Mask, " geom"]:
    """Geoms that may touch something, by their bits or an explicit pair."""
    out = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
    out[model.pair_geom1] = out[model.pair_geom2] = True
    return out
