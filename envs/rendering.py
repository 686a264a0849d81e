"""Pictures of a robot with its estimate beside it: a translucent ghost and an ellipsoid."""

import copy
import os
import sys
import time
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.envs.errors import EnvError

Array = NDArray[np.float64]
GHOST = np.array([0.15, 0.85, 0.35, 0.35], np.float32)
ELLIPSOID = np.array([1.0, 0.55, 0.05, 0.45], np.float32)
SIGMAS = 3.0
"""The ellipsoid's semi-axes, in standard deviations of the position."""
INFLATION = 1.02
"""Of the ghost's bodies: two surfaces in one place would flicker."""
THINNEST = 4e-3
"""Least semi-axis that is drawn, m: a planar robot's ellipsoid is flat."""


class GhostRenderer:
    """Draws a true state and a belief about it.

    The ghost is the estimate's moving bodies, green and translucent. The ellipsoid (orange, 3 σ) is
    the covariance J P Jᵀ of the centre of mass of every free body, or, on a robot without one, of
    the last body of each chain, with J from `mj_jacBodyCom`.

    Args:
        model: compiled MuJoCo model.
        width, height: pixels.
        camera: name or number; default the model's first camera, else a free one.
    """

    def __init__(
        self, model: mujoco.MjModel, width: int, height: int, camera: str | int | None = None
    ):
        self._model = copy.copy(model)
        self._model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        self._model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        self._size = (height, width)
        names = [model.camera(i).name for i in range(model.ncam)]
        known = camera in names or (isinstance(camera, int) and -1 <= camera < model.ncam)
        if camera is not None and not known:
            raise EnvError(f"camera is {camera!r}; the model has {names or 'none'} (-1 is free)")
        self._camera = camera if camera is not None else 0 if model.ncam else -1
        self._truth, self._ghost = mujoco.MjData(self._model), mujoco.MjData(self._model)
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._bodies = tracked_bodies(model)
        self._renderer: mujoco.Renderer | None = None
        self._viewer: Any = None
        self._due = 0.0

    def render(
        self, mode: str, x: Array, belief: tuple[Array, Array] | None = None
    ) -> NDArray[np.uint8] | None:
        """A picture `(height, width, 3)` in mode `rgb_array`; in mode `human` a window.

        Args:
            mode: `rgb_array` or `human`.
            x: true state `(nx,)`; one that is not finite is drawn as the last that was.
            belief: x̂ `(nx,)` and P `(n, n)`, or None for no ghost.

        Raises:
            EnvError: there is no display, or no OpenGL.
        """
        self._place(self._truth, x)
        if belief is not None:
            self._place(self._ghost, belief[0])
        if mode == "human":
            self._show(belief)
            return None
        if self._renderer is None:
            self._renderer = self._make_renderer()
        self._renderer.update_scene(self._truth, self._camera)
        if belief is not None:
            self._add_ghost(self._renderer.scene, belief[1])
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context and close the window."""
        if self._renderer is not None:
            self._renderer.close()
        if self._viewer is not None:
            self._viewer.close()
        self._renderer = self._viewer = None

    def _place(self, data: mujoco.MjData, x: Array) -> None:
        model = self._model
        if np.isfinite(x).all():
            data.qpos = x[: model.nq]
            data.qvel = x[model.nq : model.nq + model.nv]
            if model.na:
                data.act = x[model.nq + model.nv :]
        mujoco.mj_forward(model, data)

    def _add_ghost(self, scene: mujoco.MjvScene, cov: Array) -> None:
        """Append the estimate's moving geoms and the ellipsoids to a scene."""
        model, first = self._model, scene.ngeom
        mujoco.mjv_addGeoms(
            model, self._ghost, self._option, self._perturb,
            int(mujoco.mjtCatBit.mjCAT_DYNAMIC), scene,
        )  # fmt: skip
        for i in range(first, scene.ngeom):
            geom = scene.geoms[i]
            geom.rgba[:], geom.matid = GHOST, -1
            geom.size[:] *= INFLATION
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # no shadow
        for body in self._bodies:
            if scene.ngeom < scene.maxgeom:
                center, axes, frame = ellipsoid(model, self._ghost, body, cov)
                mujoco.mjv_initGeom(
                    scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_ELLIPSOID,
                    axes, center, frame.ravel(), ELLIPSOID,
                )  # fmt: skip
                scene.geoms[scene.ngeom].category = mujoco.mjtCatBit.mjCAT_DECOR
                scene.ngeom += 1

    def _make_renderer(self) -> mujoco.Renderer:
        try:
            return mujoco.Renderer(self._model, *self._size)
        except Exception as error:  # the OpenGL backends raise whatever they like
            raise EnvError(
                f"cannot render: {type(error).__name__}: {error}; without a display set "
                "MUJOCO_GL=osmesa (or egl) before Python starts, and install libosmesa6 or libegl1"
            ) from error

    def _show(self, belief: tuple[Array, Array] | None) -> None:
        if self._viewer is None:
            display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            if sys.platform.startswith("linux") and not display:
                raise EnvError("render_mode='human' needs a display; use render_mode='rgb_array'")
            import mujoco.viewer  # loads GLFW

            self._viewer = mujoco.viewer.launch_passive(
                self._model, self._truth, show_left_ui=False, show_right_ui=False
            )
        with self._viewer.lock():
            scene = self._viewer.user_scn
            if scene is not None:
                scene.ngeom = 0
                if belief is not None:
                    self._add_ghost(scene, belief[1])
        self._viewer.sync()
        # Real time, if the simulation is faster than that.
        time.sleep(float(np.clip(self._due - time.monotonic(), 0.0, 0.1)))
        self._due = time.monotonic() + 1 / 60


def tracked_bodies(model: mujoco.MjModel) -> list[int]:
    """Bodies whose position gets an ellipsoid: those on free joints, else the last of chains."""
    free = model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
    if free.any():
        return [int(b) for b in model.jnt_bodyid[free]]
    moving = [b for b in range(1, model.nbody) if model.body_weldid[b] != 0]
    parents = {int(model.body_parentid[b]) for b in moving}
    return [b for b in moving if b not in parents]


def ellipsoid(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, cov: Array
) -> tuple[Array, Array, Array]:
    """Centre `(3,)`, semi-axes `(3,)` (m) and frame `(3, 3)` of a body's position covariance.

    Args:
        model: compiled model.
        data: placed at the estimate by `mj_forward`.
        body: number of the body.
        cov: P `(n, n)`; its first nv rows are the positions'.
    """
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
    values, frame = np.linalg.eigh(jacobian @ cov[: model.nv, : model.nv] @ jacobian.T)
    frame = frame * np.sign(np.linalg.det(frame))
    axes = SIGMAS * np.sqrt(np.clip(values, (THINNEST / SIGMAS) ** 2, None))
    return data.xipos[body].copy(), axes, frame
