"""MuJoCo's desktop viewer, and an error that explains why it cannot open."""

import os
import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any

import mujoco

from estbench.errors import EstbenchError


class WindowError(EstbenchError):
    """No window can be opened on this machine."""


class Window:
    """MuJoCo's viewer without its panels; it draws in its own thread.

    Args:
        model: the robot.
        data: the pose that `viewer.sync()` shows.
        remedy: end of the error message: what to do without a display.
        camera: the camera at the start.
        key: called with the code of each key.

    Attributes:
        viewer: handle of MuJoCo's viewer.

    Raises:
        WindowError: there is no display, or GLFW cannot open it.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        remedy: str,
        camera: mujoco.MjvCamera,
        key: Callable[[int], None] | None = None,
    ):
        start(remedy)
        import mujoco.viewer

        before = set(threading.enumerate())
        self.viewer: Any = mujoco.viewer.launch_passive(
            model, data, key_callback=key, show_left_ui=False, show_right_ui=False
        )
        self._threads = set(threading.enumerate()) - before
        for name in ("type", "fixedcamid", "lookat", "distance", "azimuth", "elevation"):
            setattr(self.viewer.cam, name, getattr(camera, name))

    def __enter__(self) -> Any:
        return self.viewer

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the window and wait for its threads; one that draws would block Python's exit."""
        self.viewer.close()
        for thread in self._threads:
            thread.join(5.0)


def start(remedy: str) -> None:
    """Start GLFW in this thread: if it failed in the viewer's thread, MuJoCo would wait for ever.

    Args:
        remedy: end of the error message: what to do without a display.

    Raises:
        WindowError: there is no display, or GLFW cannot open it.
    """
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not shown:
        raise WindowError(f"a window needs a display, and DISPLAY is not set; {remedy}")
    try:
        import glfw

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the error below says the same
            started = glfw.init()
    except Exception as error:  # a missing library, or any error of GLFW
        reason = " ".join(str(error).split())
        raise WindowError(f"a window needs GLFW: {reason}; {remedy}") from None
    if not started:
        raise WindowError(f"a window cannot be opened on display '{shown}'; {remedy}")
