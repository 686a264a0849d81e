"""The native environment: one robot of a scenario, observed by a filter."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from estbench.envs.actions import Actions
from estbench.envs.episodes import Episodes
from estbench.envs.errors import EnvError, check_switch, not_running
from estbench.envs.rendering import GhostRenderer
from estbench.envs.world import World, prepare
from estbench.scenario.schema import Scenario
from estbench.shapes import Array

ROW = np.zeros(1, np.int64)


class ScenarioEnv(gym.Env[Array, NDArray[np.float32]]):
    """A scenario as a Gymnasium environment: `gym.make("estbench/CartPole-v0")` and others.

    The episodes after a seed s are the runs 0, 1, 2, ... of `estbench run --seed s`.

    The initial state, the disturbance and the sensors are those of the scenario; reward, end and
    horizon are those of its `[task]`. An action in [-1, 1] spans the actuator's ctrlrange.

    Args:
        scenario: bundled name, TOML or MJCF path, or a `Scenario`.
        estimator: a label of the scenario, a name, `package.module:Name`, a table of settings with
            `type`, or None for no filter (then `observe` is `raw` or `truth`).
        observe: `state`, `belief`, `covariance`, `raw` or `truth`; see `estbench.envs.features`.
        sensors: channels in use; default the scenario's.
        overrides: `section.key=value` strings, as on the command line.
        normalize_actions: whether actions are in [-1, 1] rather than in the actuators' units.
        render_mode: `rgb_array`, `human` or None.
        width, height: of the picture, pixels.
        camera: name or number of a camera; default the model's first.
        ghost: whether the estimate is drawn beside the truth.
        nthread: threads of the filter's physics, on which no result depends; default as many of
            the cores as make it faster, which is timed while it runs.

    Raises:
        EstbenchError: a setting is wrong; the message names the remedy.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        scenario: str | Path | Scenario | None = None,
        estimator: str | Mapping[str, Any] | None = "ekf",
        observe: str = "state",
        sensors: Sequence[str] | None = None,
        overrides: Sequence[str] = (),
        normalize_actions: bool = True,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str | int | None = None,
        ghost: bool = True,
        nthread: int | None = None,
    ):
        check_switch("ghost", ghost)
        prepared = prepare(scenario, estimator, sensors, overrides)
        self.world = World(prepared, 1, estimator is not None, nthread, look=observe == "raw")
        self._actions = Actions(prepared.plant.model, normalize_actions)
        self.action_space = self._actions.space
        self._observe = self.world.features(observe)
        self.observation_space = self._observe.space
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / prepared.plant.period))}
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise EnvError(f"render_mode is '{render_mode}'; use 'rgb_array', 'human' or None")
        self.render_mode = render_mode
        self._renderer = GhostRenderer(prepared.plant.model, width, height, camera)
        self._ghost = ghost and estimator is not None
        self._episodes = Episodes(1)
        self._running = self._closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; `options` is not used.

        Returns:
            The observation `(k,)` and the info of `estbench.inference.live.LiveFilter.info`.
        """
        if self._closed:
            raise not_running(True)
        super().reset(seed=seed)
        self._episodes.seed(0, seed)
        self.world.reset(ROW, *self._episodes.next(ROW))
        self._running = True
        if self.render_mode == "human":
            self.render()
        return self._seen()

    def step(self, action: NDArray[np.float32]) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control period under an action `(nu,)`.

        Raises:
            EnvError: the action is outside the space, the episode is over, or the environment is
                closed.
        """
        if not self._running:
            raise not_running(self._closed)
        u = self._actions.controls(np.asarray(action))[None]
        reward, ended, late = self.world.step(u)
        self._running = not (ended[0] or late[0])
        if self.render_mode == "human":
            self.render()
        observation, info = self._seen()
        return observation, float(reward[0]), bool(ended[0]), bool(late[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """The picture `(height, width, 3)` in mode `rgb_array`; a window in mode `human`."""
        if self.render_mode is None:
            return None
        belief = self.world.belief(0) if self._ghost else None
        return self._renderer.render(self.render_mode, self.world.x[0], belief)

    def close(self) -> None:
        """Release the renderer and the backends; nothing can follow."""
        self._running, self._closed = False, True
        self._renderer.close()
        self.world.close()

    def _seen(self) -> tuple[Array, dict[str, Any]]:
        return self._observe(self.world.x)[0].copy(), first(self.world.info())


def first(info: dict[str, Any]) -> dict[str, Any]:
    """The info of the first row: arrays without the row axis, numbers as Python numbers."""
    return {k: v.item() if v.ndim == 1 else v[0] for k, v in info.items()}
