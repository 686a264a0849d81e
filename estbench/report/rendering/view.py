"""`estbench view`: the player in a browser (MuJoCo's web viewer on loopback) or in a window."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from estbench.report.rendering import loopback
from estbench.report.rendering.loopback import ViewError
from estbench.report.rendering.player import COMMANDS, FRAME, KEYS, Player
from estbench.report.rendering.render import find_camera
from estbench.report.rendering.scene import add_belief, lit
from estbench.report.rendering.window import Window


def watch(
    source: str | Path,
    estimator: str | None = None,
    run: int = 0,
    *,
    port: int = 0,
    window: bool = False,
    overrides: Sequence[str] = (),
) -> None:
    """Show truth and estimate until the viewer is closed or Ctrl-C is pressed.

    Args:
        source: bundled name, TOML or MJCF path.
        estimator: label; default the first.
        run: number of the first run.
        port: port of the web page; 0 takes the first free one from 8080.
        window: whether to open a desktop window instead of the page.
        overrides: `section.key=value` strings.

    Raises:
        WindowError: there is no display.
        ViewError: this MuJoCo has no web viewer.
        EstbenchError: a mistake in the scenario.
    """
    player = Player(source, estimator, run, overrides)
    try:
        (_window if window else _page)(player, port)
    finally:
        player.close()


class Ghost:
    """The ghost and the ellipsoids at the instant that a player shows."""

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self._data = mujoco.MjData(model)

    def update(self, player: Player, scene: mujoco.MjvScene) -> None:
        """Replace the geoms of a scene by the ghost and the ellipsoids."""
        replay, step = player.replay, player.step
        scene.ngeom = 0
        add_belief(scene, self.model, self._data, replay.estimate[step], replay.cov[step])


def _place(player: Player, data: mujoco.MjData) -> None:
    """Write the true state that the player shows into data."""
    replay, step = player.replay, player.step
    x, nq, nv = replay.truth[step], replay.model.nq, replay.model.nv
    if np.isfinite(x).all():
        data.qpos[:], data.qvel[:] = x[:nq], x[nq : nq + nv]
    data.time = float(player.time)


def _clock() -> Callable[[], float]:
    """A function that returns the seconds since its last call, at most 0.1 after a delay."""
    last = time.monotonic()

    def passed() -> float:
        nonlocal last
        now = time.monotonic()
        seconds, last = min(now - last, 0.1), now
        return seconds

    return passed


def _page(player: Player, port: int) -> None:
    """Serve MuJoCo's web viewer on loopback until it is closed.

    Raises:
        ViewError: there is no web viewer, or the page cannot be served.
    """
    try:
        from mujoco.studio import launch_web, messages, plugin, viewer_protocol
        from mujoco.studio.dear_imgui import dear_imgui as imgui
    except ImportError as error:
        raise ViewError(
            f"this MuJoCo has no web viewer ({error}); use --window on a desktop"
        ) from None

    model = player.replay.model
    ghost = Ghost(model)
    scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + model.nbody + 10)

    class Overlay(plugin.ViewerPlugin):
        """The ghost, a panel of text and buttons, and the keys."""

        def __init__(self) -> None:
            self._looked = False

        @messages.handler
        def on_update(self, _: messages.UpdateEvent) -> None:
            if not self._looked and self.viewer.model.nbody == model.nbody:
                mujoco.mjv_defaultFreeCamera(self.viewer.model, self.viewer.camera)
                self._looked = True
            ghost.update(player, scene)
            self.viewer.extra_geoms[:] = [scene.geoms[i] for i in range(scene.ngeom)]

        @messages.handler
        def on_gui(self, _: messages.BuildGuiEvent) -> None:
            imgui.Begin("estbench")
            for line in player.lines():
                imgui.TextUnformatted(line)
            for row in ((" ", "r", "n"), ("[", "]"), ("-", "="), (",", ".")):
                for i, key in enumerate(row):
                    if i:
                        imgui.SameLine()
                    name = "space" if key == " " else key
                    if imgui.Button(f"{COMMANDS[key]} ({name})"):
                        player.command(COMMANDS[key])
            imgui.End()
            if not imgui.GetIO().WantCaptureKeyboard:
                for key, code in _imgui_keys(imgui).items():
                    if imgui.IsKeyPressed(code):
                        player.command(COMMANDS[key])

    config = viewer_protocol.ViewerConfig(title="estbench view", gfx="web", http_port=port)
    config.open_browser = True
    passed = _clock()
    with loopback.only() as address:
        try:
            with launch_web.launch(config, plugins=[Overlay()]) as handle:
                data = mujoco.MjData(model)
                handle.set_model(model, data=data)
                while handle.is_running():
                    player.advance(passed())
                    _place(player, data)
                    handle.sync()
                    time.sleep(FRAME)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise ViewError(f"the page cannot be served at {address}: {reason}") from None


def _imgui_keys(imgui: Any) -> dict[str, Any]:
    """Character of `COMMANDS` -> key of Dear ImGui."""
    key = imgui.Key
    return {
        " ": key.Space, "[": key.LeftBracket, "]": key.RightBracket, "-": key.Minus,
        "=": key.Equal, ",": key.Comma, ".": key.Period, "n": key.N, "r": key.R,
    }  # fmt: skip


def _window(player: Player, port: int) -> None:
    """Show MuJoCo's desktop viewer until it is closed."""
    model = lit(player.replay.model)
    data, ghost, passed = mujoco.MjData(model), Ghost(model), _clock()

    def key(code: int) -> None:
        player.command(COMMANDS.get(chr(max(code, 0)).lower(), ""))  # -1: a key without a name

    _place(player, data)
    mujoco.mj_forward(model, data)
    camera, _ = find_camera(model, None)
    remedy = "without --window the view is served to a browser"
    window = Window(model, data, remedy, camera, key)
    for name, what in KEYS.items():
        print(f"  {name:8} {what}")
    with window as viewer:
        while viewer.is_running():
            player.advance(passed())
            with viewer.lock():
                _place(player, data)
                mujoco.mj_forward(model, data)
                ghost.update(player, viewer.user_scn)
            viewer.set_texts([(None, None, "\n".join(player.lines()), "")])
            viewer.sync()
            time.sleep(FRAME)
