"""An estimate in a MuJoCo scene: a translucent ghost and covariance ellipsoids.

The functions append to any `mujoco.MjvScene` and need no OpenGL. The report's pictures, videos, the
live view and the environments use them.
"""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from estbench.shapes import Array

GHOST = (0.0, 0.62, 0.45, 0.45)
"""Green of Okabe and Ito: colour-blind readers can tell it from blue, orange and red robots."""
ELLIPSOID = (0.80, 0.47, 0.65, 0.35)
SIGMAS = 3.0
"""Semi-axes of the ellipsoid in standard deviations."""
THINNEST = 5e-3
"""Smallest semi-axis drawn over the robot's size: a planar robot's ellipsoid is flat."""
_AMBIENT, _DIFFUSE = 0.4, 0.8  # of the headlight, if the model has no other light
_SWELL = 1.015  # surfaces of equal depth would flicker where the ghost is on the truth


def lit(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model to draw, with a brighter headlight if the model has no light.

    With MuJoCo's default headlight only, a robot without a floor is nearly black.
    """
    model = copy.copy(model)
    if model.nlight == 0:
        head = model.vis.headlight
        head.ambient, head.diffuse = (
            np.maximum(head.ambient, _AMBIENT), np.maximum(head.diffuse, _DIFFUSE),
        )  # fmt: skip
    return model


def add_belief(
    scene: mujoco.MjvScene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    estimate: Array,
    cov: Array | None = None,
    option: mujoco.MjvOption | None = None,
    ghost: bool = True,
) -> range:
    """Append the ghost at an estimate and the ellipsoids of its position covariance to a scene.

    Args:
        scene: the scene.
        model: the robot.
        data: working memory; the estimate is written into it.
        estimate: x̂ `(nx,)`; nothing is appended if it is not finite.
        cov: P `(n, n)`, in the tangent at the estimate; no ellipsoids if None.
        option: as in `add_ghost`.
        ghost: whether to append the ghost, or the ellipsoids alone.

    Returns:
        Indices of the ghost's geoms in `scene.geoms`.
    """
    if not np.isfinite(estimate).all():
        return range(0)
    pose(model, data, estimate)
    added = add_ghost(scene, model, data, option=option) if ghost else range(0)
    if cov is not None:
        for body in tips(model):
            centre, spread = position_covariance(model, data, body, cov)
            add_ellipsoid(scene, centre, spread, smallest=THINNEST * float(model.stat.extent))
    return added


def add_ghost(
    scene: mujoco.MjvScene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    rgba: Sequence[float] = GHOST,
    option: mujoco.MjvOption | None = None,
) -> range:
    """Append the moving parts of a second pose to a scene, in one translucent colour.

    Call it after `mjv_updateScene` (or `Renderer.update_scene`), which clears the scene.

    Args:
        scene: the scene.
        model: the robot.
        data: the pose, after `mj_forward` or `mj_kinematics`.
        rgba: colour and opacity.
        option: visible elements; default `plain()`.

    Returns:
        Indices of the new geoms in `scene.geoms`.
    """
    option = option or plain()
    start = scene.ngeom
    mujoco.mjv_addGeoms(
        model, data, option, mujoco.MjvPerturb(), int(mujoco.mjtCatBit.mjCAT_DYNAMIC), scene
    )
    added = range(start, scene.ngeom)
    for i in added:
        geom = scene.geoms[i]
        geom.matid, geom.texid = -1, -1
        geom.rgba = np.asarray(rgba, np.float32)
        geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)  # casts no shadow
        geom.transparent = 1
        geom.reflectance, geom.segid = 0.0, -1
        if geom.type != mujoco.mjtGeom.mjGEOM_MESH:
            geom.size = geom.size * _SWELL
    return added


def add_ellipsoid(
    scene: mujoco.MjvScene,
    centre: Array,
    cov: Array,
    rgba: Sequence[float] = ELLIPSOID,
    sigmas: float = SIGMAS,
    smallest: float = 1e-3,
) -> int | None:
    """Append the ellipsoid of a 3-D covariance to a scene.

    Args:
        scene: the scene.
        centre: centre of the ellipsoid `(3,)`, m.
        cov: covariance of the position `(3, 3)`, m².
        rgba: colour and opacity.
        sigmas: semi-axes in standard deviations.
        smallest: smallest semi-axis, m, so that a flat ellipsoid is visible.

    Returns:
        Index of the ellipsoid in `scene.geoms`; None if the scene is full or a value not finite.
    """
    if scene.ngeom >= scene.maxgeom or not (np.isfinite(cov).all() and np.isfinite(centre).all()):
        return None
    variance, axes = np.linalg.eigh(0.5 * (cov + cov.T))
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    size = np.maximum(sigmas * np.sqrt(np.maximum(variance, 0.0)), smallest)
    index = scene.ngeom
    mujoco.mjv_initGeom(
        scene.geoms[index], mujoco.mjtGeom.mjGEOM_ELLIPSOID, size, centre, axes.ravel(),
        np.asarray(rgba, np.float32),
    )  # fmt: skip
    scene.geoms[index].category = int(mujoco.mjtCatBit.mjCAT_DECOR)
    scene.geoms[index].transparent = 1
    scene.ngeom += 1
    return index


def tips(model: mujoco.MjModel) -> tuple[int, ...]:
    """Bodies whose position covariance is drawn, one per kinematic tree.

    The body is that of the free joint, or in a tree that is fixed to the world the end of the
    longest chain.
    """
    depth = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    found = []
    for tree in sorted({int(t) for t in model.body_treeid if t >= 0}):
        bodies = np.flatnonzero(model.body_treeid == tree)
        root = bodies[0]
        joint = model.body_jntadr[root]
        free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        found.append(int(root if free else bodies[depth[bodies].argmax()]))
    return tuple(found)


def position_covariance(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, cov: Array
) -> tuple[Array, Array]:
    """Centre of mass of a body `(3,)` m and its covariance `(3, 3)` m².

    The covariance is J P Jᵀ with the Jacobian J of the position with respect to the tangent of the
    pose, and the first `(nv, nv)` block of P.

    Args:
        model: the robot.
        data: the estimated pose, after `mj_forward`.
        body: index of the body.
        cov: P `(n, n)`, n >= nv, in the tangent at the estimate.
    """
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
    return data.xipos[body].copy(), jacobian @ cov[: model.nv, : model.nv] @ jacobian.T


def pose(model: mujoco.MjModel, data: mujoco.MjData, x: Array) -> None:
    """Write a state `(nx,)` into data and compute the poses of the bodies."""
    data.qpos[:] = x[: model.nq]
    data.qvel[:] = x[model.nq : model.nq + model.nv]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    mujoco.mj_camlight(model, data)


def plain() -> mujoco.MjvOption:
    """Visible elements: geoms of the default groups, no sites."""
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    return option
