"""Drawing a robot with MuJoCo: the truth, a translucent ghost of the estimate, its covariance.

The primitives `add_ghost` and `add_ellipsoid` append to any `mujoco.MjvScene` and need no OpenGL;
`Renderer` turns a scene into pixels without a display, by OSMesa or EGL, whichever works.
"""

import ctypes
import ctypes.util
import os
import platform
import struct
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstbenchError

Array = NDArray[np.float64]

GHOST = (0.0, 0.62, 0.45, 0.45)
"""Green of Okabe and Ito: told from the blue, orange and red robots by colour-blind readers too."""
ELLIPSOID = (0.80, 0.47, 0.65, 0.35)
SIGMAS = 3.0
"""Semi-axes of the ellipsoid in standard deviations."""
_SWELL = 1.015  # a ghost exactly on the truth would fight with it for the same pixels


class RenderError(EstbenchError):
    """Nothing can be drawn on this machine."""


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
        scene: to append to.
        model: the robot.
        data: the pose, after `mj_forward` or `mj_kinematics`.
        rgba: colour and opacity.
        option: what is visible; MuJoCo's defaults without sites, tendons and the like.

    Returns:
        Indices of the new geoms in `scene.geoms`.
    """
    option = option or _plain()
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
    """Append the ellipsoid of a 3-D covariance; its index, or None where the scene is full.

    Args:
        scene: to append to.
        centre: `(3,)` m.
        cov: `(3, 3)` m².
        rgba: colour and opacity.
        sigmas: semi-axes in standard deviations.
        smallest: least semi-axis, m, so that a flat ellipsoid is still seen.
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
    """Bodies whose position covariance is worth drawing, one a kinematic tree.

    The body of a free joint; in a tree fixed to the world, the end of its longest chain.
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

    J P J' with the Jacobian of the position by the pose's tangent and P's first `(nv, nv)` block.

    Args:
        model: the robot.
        data: the estimated pose, after `mj_forward`.
        body: index.
        cov: P `(n, n)`, n >= nv, in the tangent at the estimate.
    """
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
    return data.xipos[body].copy(), jacobian @ cov[: model.nv, : model.nv] @ jacobian.T


def pose(model: mujoco.MjModel, data: mujoco.MjData, x: Array) -> None:
    """Put a state `(nx,)` into data and compute where the bodies are."""
    data.qpos[:] = x[: model.nq]
    data.qvel[:] = x[model.nq : model.nq + model.nv]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


class Renderer:
    """Pixels of one robot, of its ghost and of the ghost's position covariance; no display needed.

    Args:
        model: the robot; its offscreen buffer is enlarged where it is too small.
        width, height: pixels.
        camera: a camera of the model; default `view`, else its first, else one that follows.

    Raises:
        RenderError: neither OSMesa nor EGL works here, or there is no such camera.
    """

    def __init__(
        self, model: mujoco.MjModel, width: int = 640, height: int = 480, camera: str | None = None
    ):
        self.model = model
        self._rect = mujoco.MjrRect(0, 0, width, height)
        size = model.vis.global_
        size.offwidth, size.offheight = max(size.offwidth, width), max(size.offheight, height)
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, 1024)  # drawn by the CPU
        self.scene = mujoco.MjvScene(model, maxgeom=4 * model.ngeom + 4 * model.nsite + 200)
        self.camera, self._follows = _camera(model, camera)
        self._option = _plain()
        self._truth, self._ghost = mujoco.MjData(model), mujoco.MjData(model)
        self._gl = context(width, height)
        self._gl.make_current()
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context; call it, or use `with`."""
        if self._gl is not None:
            self._gl.make_current()
            self._mjr.free()
            self._gl.free()
            self._gl = None

    def draw(self, x: Array, estimate: Array | None = None, cov: Array | None = None) -> NDArray:
        """One picture `(height, width, 3)` of unsigned bytes.

        Args:
            x: true state `(nx,)`.
            estimate: x̂ `(nx,)`; no ghost without it, nor where it is not finite.
            cov: P `(n, n)`; no ellipsoid without it.
        """
        self.update(x, estimate, cov)
        self._gl.make_current()
        mujoco.mjr_render(self._rect, self.scene, self._mjr)
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._mjr)
        return pixels[::-1]

    def update(self, x: Array, estimate: Array | None, cov: Array | None) -> range:
        """Fill the scene; the indices of the ghost's geoms."""
        if np.isfinite(x).all():
            pose(self.model, self._truth, x)
        if self._follows:
            self.camera.lookat = self._truth.subtree_com[0]
        mujoco.mjv_updateScene(
            self.model, self._truth, self._option, mujoco.MjvPerturb(), self.camera,
            int(mujoco.mjtCatBit.mjCAT_ALL), self.scene,
        )  # fmt: skip
        if estimate is None or not np.isfinite(estimate).all():
            return range(0)
        pose(self.model, self._ghost, estimate)
        ghost = add_ghost(self.scene, self.model, self._ghost, option=self._option)
        if cov is not None:
            for body in tips(self.model):
                centre, spread = position_covariance(self.model, self._ghost, body, cov)
                add_ellipsoid(
                    self.scene, centre, spread, smallest=5e-3 * float(self.model.stat.extent)
                )
        return ghost


def context(width: int, height: int) -> Any:
    """An OpenGL context that needs no display, with `make_current()` and `free()`.

    `MUJOCO_GL` is obeyed; else EGL where there is a graphics card, then OSMesa, then EGL.

    Raises:
        RenderError: none works; the message says what to install.
    """
    if platform.system() != "Linux":
        from mujoco.gl_context import GLContext  # pyright: ignore[reportAttributeAccessIssue]

        return GLContext(width, height)
    tried = []
    for name in _candidates():
        try:
            if name == "osmesa":
                from mujoco.osmesa import GLContext
            elif name == "egl":
                from mujoco.egl import GLContext
            else:
                from mujoco.glfw import GLContext
            return GLContext(width, height)
        except Exception as error:  # each library fails in its own way
            tried.append(f"{name}: {' '.join(str(error).split())[:120] or type(error).__name__}")
    reason = f" ({'; '.join(tried)})" if tried else ""
    raise RenderError(
        "nothing can be drawn here: neither OSMesa nor EGL works; install one, e.g. "
        f"apt-get install libosmesa6 (or libegl1 with a graphics driver){reason}"
    )


def available() -> bool:
    """Whether pictures can be drawn on this machine."""
    try:
        gl = context(16, 16)
    except RenderError:
        return False
    gl.free()
    return True


def _candidates() -> list[str]:
    """Names to try: PyOpenGL takes one platform a process, so only what has its library."""
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in ("osmesa", "egl", "glfw"):
        return [wanted]
    fixed = os.environ.get("PYOPENGL_PLATFORM") if "OpenGL" in sys.modules else None
    if fixed in ("osmesa", "egl"):
        return [fixed]
    card = any(Path("/dev/dri").glob("renderD*")) or Path("/dev/nvidiactl").exists()
    egl = ["egl"] if _egl_display() else []
    osmesa = ["osmesa"] if ctypes.util.find_library("OSMesa") else []
    return (egl + osmesa if card else osmesa + egl)[:1]


def _egl_display() -> bool:
    """Whether EGL offers a device: asked by ctypes, as PyOpenGL could not be asked twice."""
    name = ctypes.util.find_library("EGL")
    if name is None:
        return False
    try:
        address = ctypes.CDLL(name).eglGetProcAddress
        address.restype, address.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
        pointer = address(b"eglQueryDevicesEXT")
        if not pointer:
            return False
        query = ctypes.CFUNCTYPE(
            ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int)
        )(pointer)
        count = ctypes.c_int(0)
        return bool(query(0, None, ctypes.byref(count))) and count.value > 0
    except (OSError, AttributeError):
        return False


def _plain() -> mujoco.MjvOption:
    """What is visible: geoms of the default groups, no sites."""
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    return option


def _camera(model: mujoco.MjModel, name: str | None) -> tuple[mujoco.MjvCamera, bool]:
    """The camera, and whether its target must follow the robot."""
    camera = mujoco.MjvCamera()
    names = [model.camera(i).name for i in range(model.ncam)]
    if name is not None and name not in names:
        raise RenderError(f"no camera '{name}' (known: {', '.join(names) or 'none'})")
    if names:
        chosen = name or ("view" if "view" in names else names[0])
        camera.type = int(mujoco.mjtCamera.mjCAMERA_FIXED)
        camera.fixedcamid = names.index(chosen)
        return camera, False
    mujoco.mjv_defaultFreeCamera(model, camera)
    return camera, True


def png(pixels: NDArray) -> bytes:
    """A picture `(height, width, 3)` of unsigned bytes as a PNG file."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    height, width = pixels.shape[:2]
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 9))
        + chunk(b"IEND", b"")
    )
