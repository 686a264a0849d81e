"""Pictures of a robot with its estimate beside it, drawn as the reports draw them."""

import time
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.report.rendering import render, scene, window
from estbench.shapes import Array

Belief = tuple[Array, Array]
LARGEST = 16384
"""Pixels of a side; OpenGL's buffers are no larger on most machines."""


class GhostRenderer:
    """Draws a true state and a belief about it; what is drawn of the belief is in `report.scene`.

    Args:
        model: compiled MuJoCo model.
        width, height: pixels.
        camera: name or number, -1 for a free one; default `view`, else the first, else a free one.

    Raises:
        RenderError: there is no such camera, or a side has no whole number of pixels.
    """

    def __init__(
        self, model: mujoco.MjModel, width: int, height: int, camera: str | int | None = None
    ):
        for name, side in (("width", width), ("height", height)):
            if not (isinstance(side, int) and 1 <= side <= LARGEST):
                raise render.RenderError(
                    f"{name} is {side!r}; use a whole number of pixels from 1 to {LARGEST}"
                )
        self._model = scene.lit(model)
        self._camera, _ = render.find_camera(self._model, camera)
        self._look = width, height, camera
        self._renderer: render.Renderer | None = None
        self._shown: Shown | None = None

    def render(self, mode: str, x: Array, belief: Belief | None = None) -> NDArray | None:
        """A picture `(height, width, 3)` of bytes in mode `rgb_array`; in mode `human` a window.

        Args:
            mode: `rgb_array` or `human`.
            x: true state `(nx,)`; one that is not finite is drawn as the last that was.
            belief: x̂ `(nx,)` and P `(n, n)`, or None for no ghost.

        Raises:
            WindowError: there is no display.
            RenderError: there is no OpenGL.
        """
        if mode == "human":
            self._shown = self._shown or Shown(self._model, self._camera)
            self._shown.draw(x, belief)
            return None
        self._renderer = self._renderer or render.Renderer(self._model, *self._look)
        return self._renderer.draw(x, *(belief or (None, None)))

    def __getstate__(self) -> dict[str, Any]:
        """A copy opens its own context and window."""
        return {"model": self._model, "look": self._look}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["model"], *state["look"])

    def close(self) -> None:
        """Free the OpenGL context and close the window."""
        for opened in (self._renderer, self._shown):
            if opened is not None:
                opened.close()
        self._renderer = self._shown = None


class Shown:
    """MuJoCo's desktop viewer with the ghost in it, no faster than real time.

    Once its user has closed it, nothing is drawn any more.

    Raises:
        WindowError: there is no display.
    """

    def __init__(self, model: mujoco.MjModel, camera: mujoco.MjvCamera):
        self._model = model
        self._truth, self._ghost = mujoco.MjData(model), mujoco.MjData(model)
        self._window = window.Window(model, self._truth, "use render_mode='rgb_array'", camera)
        self._due = 0.0

    def draw(self, x: Array, belief: Belief | None) -> None:
        """Show a true state `(nx,)` and a belief, x̂ `(nx,)` and P `(n, n)`."""
        viewer = self._window.viewer
        if not viewer.is_running():
            return
        with viewer.lock():
            if np.isfinite(x).all():
                scene.pose(self._model, self._truth, x)
            viewer.user_scn.ngeom = 0
            if belief is not None:
                scene.add_belief(viewer.user_scn, self._model, self._ghost, *belief)
        viewer.sync()
        time.sleep(float(np.clip(self._due - time.monotonic(), 0.0, 0.1)))
        self._due = time.monotonic() + 1 / 60

    def close(self) -> None:
        """Close the window."""
        self._window.close()
