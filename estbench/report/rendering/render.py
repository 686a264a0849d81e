"""Rendering without a display: MuJoCo with OSMesa or EGL."""

import atexit
import ctypes
import ctypes.util
import os
import platform
import struct
import sys
import weakref
import zlib
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstbenchError
from estbench.report.rendering.scene import add_belief, lit, plain, pose
from estbench.report.rendering.window import start
from estbench.shapes import Array


class RenderError(EstbenchError):
    """Nothing can be drawn on this machine."""


class Renderer:
    """Renders one robot, its ghost and the ghost's position covariance, without a display.

    Args:
        model: the robot; a copy of it is drawn (see `scene.lit`), with a larger offscreen buffer
            if needed.
        width, height: size of the picture, pixels.
        camera: name or number of a camera of the model, -1 for one that follows the robot; default
            `view`, else the first one, else one that follows.

    Raises:
        RenderError: neither OSMesa nor EGL works on this machine, or there is no such camera.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 640,
        height: int = 480,
        camera: str | int | None = None,
    ):
        self.model = model = lit(model)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        size = model.vis.global_
        size.offwidth, size.offheight = max(size.offwidth, width), max(size.offheight, height)
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, 1024)  # the CPU draws it
        self.scene = mujoco.MjvScene(model, maxgeom=4 * model.ngeom + 4 * model.nsite + 200)
        self.camera, self._follows = find_camera(model, camera)
        self._option = plain()
        self._truth, self._ghost = mujoco.MjData(model), mujoco.MjData(model)
        self._gl = context(width, height)
        self._gl.make_current()
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self.close = weakref.finalize(self, _free, self._gl, self._mjr)
        """Free the OpenGL context: on a call, at garbage collection, or at the end of Python."""
        atexit.register(self.close)  # before mujoco.egl ends its display; weakref's own comes after

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def draw(
        self, x: Array | None, estimate: Array | None = None, cov: Array | None = None
    ) -> NDArray:
        """One picture `(height, width, 3)` of unsigned bytes.

        Args:
            x: true state `(nx,)`; None if it is not known: the robot is then at the estimate.
            estimate: x̂ `(nx,)`; no ghost if None or not finite.
            cov: P `(n, n)`; no ellipsoid if None.
        """
        self.update(x, estimate, cov)
        self._gl.make_current()
        mujoco.mjr_render(self._rect, self.scene, self._mjr)
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._mjr)
        return pixels[::-1]

    def update(self, x: Array | None, estimate: Array | None, cov: Array | None) -> range:
        """Fill the scene and return the indices of the ghost's geoms."""
        shown = estimate if x is None else x
        if shown is not None and np.isfinite(shown).all():
            pose(self.model, self._truth, shown)
        if self._follows:
            self.camera.lookat = self._truth.subtree_com[0]
        mujoco.mjv_updateScene(
            self.model, self._truth, self._option, mujoco.MjvPerturb(), self.camera,
            int(mujoco.mjtCatBit.mjCAT_ALL), self.scene,
        )  # fmt: skip
        if estimate is None:
            return range(0)
        return add_belief(
            self.scene, self.model, self._ghost, estimate, cov, self._option, ghost=x is not None
        )


def _free(gl: Any, mjr: mujoco.MjrContext) -> None:
    """Free MuJoCo's rendering context, then the OpenGL context."""
    gl.make_current()
    mjr.free()
    gl.free()


def context(width: int, height: int) -> Any:
    """An OpenGL context that needs no display, with `make_current()` and `free()`.

    `MUJOCO_GL` chooses the library; without it EGL is used where it finds a device, in software
    too, else OSMesa: torch that is imported after OSMesa's library crashes the process.

    Raises:
        RenderError: no library works; the message says what to install.
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

                start("unset MUJOCO_GL")
            return GLContext(width, height)
        except Exception as error:  # the exception depends on the library
            tried.append(f"{name}: {' '.join(str(error).split())[:120] or type(error).__name__}")
    reason = f" ({'; '.join(tried)})" if tried else ""
    chosen = _wanted()
    what = f"MUJOCO_GL={chosen} does not work" if chosen else "neither OSMesa nor EGL works"
    raise RenderError(
        f"nothing can be drawn here: {what}; {'unset it, or ' if chosen else ''}install one, e.g. "
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


def _wanted() -> str:
    """The library that MUJOCO_GL names, or "" if it names none of the three."""
    name = os.environ.get("MUJOCO_GL", "").lower().strip()
    return name if name in ("osmesa", "egl", "glfw") else ""


def _candidates() -> list[str]:
    """The library to try: only an installed one, since PyOpenGL has one platform per process."""
    if wanted := _wanted():
        return [wanted]
    fixed = os.environ.get("PYOPENGL_PLATFORM") if "OpenGL" in sys.modules else None
    if fixed in ("osmesa", "egl"):
        return [fixed]
    if _egl_display():
        return ["egl"]
    return ["osmesa"] if ctypes.util.find_library("OSMesa") else []


def _egl_display() -> bool:
    """Whether EGL offers a device; by ctypes, because PyOpenGL keeps its first platform."""
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


def find_camera(model: mujoco.MjModel, wanted: str | int | None) -> tuple[mujoco.MjvCamera, bool]:
    """The camera of `Renderer`, and whether its target must follow the robot.

    Raises:
        RenderError: there is no such camera.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    known = wanted in names or (isinstance(wanted, int) and -1 <= wanted < len(names))
    if wanted is not None and not known:
        raise RenderError(
            f"camera is {wanted!r}; the model has {', '.join(names) or 'none'} (-1 is free)"
        )
    camera = mujoco.MjvCamera()
    if not names or wanted == -1:
        mujoco.mjv_defaultFreeCamera(model, camera)
        return camera, True
    chosen = wanted if wanted is not None else "view" if "view" in names else 0
    camera.type = int(mujoco.mjtCamera.mjCAMERA_FIXED)
    camera.fixedcamid = names.index(chosen) if isinstance(chosen, str) else chosen
    return camera, False
