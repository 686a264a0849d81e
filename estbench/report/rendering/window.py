"""MuJoCo's desktop viewer, or a line that says why there can be none."""

import os
import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any

import mujoco

from estbench.errors import EstbenchError


class WindowError(EstbenchError):
    """No window can be opened here."""


class Window:
    """MuJoCo's viewer without its panels; it draws in a thread of its own.

    Args:
        model: the robot.
        data: the pose that `viewer.sync()` shows.
        remedy: what to do without a display, the end of the message.
        camera: what it looks through at first.
        key: called with the code of each key.

    Attributes:
        viewer: MuJoCo's handle.

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
        """Close it and wait for its last frame: one that is drawn as Python ends would hang it."""
        self.viewer.close()
        for thread in self._threads:
            thread.join(5.0)


def start(remedy: str) -> None:
    """Start GLFW, here: in the viewer's thread its failure would be waited for for ever.

    Args:
        remedy: what to do without a display, the end of the message.

    Raises:
        WindowError: there is no display, or GLFW cannot open it.
    """
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not shown:
        raise WindowError(f"a window needs a display, and DISPLAY is not set; {remedy}")
    try:
        import glfw

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns of what is raised below
            started = glfw.init()
    except Exception as error:  # a missing library, or whatever GLFW raises
        reason = " ".join(str(error).split())
        raise WindowError(f"a window needs GLFW: {reason}; {remedy}") from None
    if not started:
        raise WindowError(f"a window cannot be opened on display '{shown}'; {remedy}")
