"""The native vector environment: all robots of a scenario in a few calls per step."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from estbench.envs.actions import Actions
from estbench.envs.episodes import Episodes
from estbench.envs.errors import EnvError, check_switch, not_running
from estbench.envs.native import ScenarioEnv
from estbench.envs.rendering import GhostRenderer
from estbench.envs.rows import MODES, add_final, reset_mask, row_seeds, vector_info
from estbench.envs.world import World, prepare
from estbench.montecarlo.executors import cpu_count
from estbench.scenario.schema import Scenario
from estbench.shapes import Array, Mask


class ScenarioVectorEnv(VectorEnv[Array, Array, Array]):
    """`num_envs` robots of one scenario: `gym.make_vec("estbench/CartPole-v0", num_envs=256)`.

    Row i with seed s is `ScenarioEnv` with seed s + i: the same truth to the last bit, the same
    estimate to rounding. Truth, sensors and filters of all rows are stepped together.

    Args:
        num_envs: how many rows.
        autoreset_mode: `NextStep`, `SameStep` or `Disabled` (or `gymnasium.vector.AutoresetMode`).
        max_episode_steps: horizon in place of the task's.
        nthread: threads of the physics; default the CPUs this process may use.
        scenario, estimator, observe, sensors, overrides, normalize_actions, render_mode, width,
            height, camera, ghost: as for `estbench.envs.native.ScenarioEnv`.

    Raises:
        EstbenchError: a setting is wrong; the message names the remedy.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str | Path | Scenario | None = None,
        estimator: str | Mapping[str, Any] | None = "ekf",
        observe: str = "state",
        sensors: Sequence[str] | None = None,
        overrides: Sequence[str] = (),
        normalize_actions: bool = True,
        autoreset_mode: str | AutoresetMode = "NextStep",
        max_episode_steps: int | None = None,
        nthread: int | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str | int | None = None,
        ghost: bool = True,
    ):
        if num_envs < 1:
            raise EnvError(f"num_envs is {num_envs}; use at least 1")
        if autoreset_mode not in MODES:
            raise EnvError(
                f"autoreset_mode is '{autoreset_mode}'; use one of NextStep, SameStep, Disabled"
            )
        if render_mode not in (None, "rgb_array"):
            raise EnvError(f"render_mode is '{render_mode}'; a vector has 'rgb_array' or None")
        prepared = prepare(scenario, estimator, sensors, overrides)
        threads = nthread or cpu_count()
        self.num_envs = num_envs
        self.world = World(
            prepared, num_envs, estimator is not None, threads, look=observe == "raw"
        )
        if max_episode_steps is not None:
            self.world.limit(max_episode_steps)
        self._actions = Actions(prepared.plant.model, normalize_actions)
        self.single_action_space = self._actions.space
        self._observe = self.world.features(observe)
        self.single_observation_space = self._observe.space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            **ScenarioEnv.metadata,
            "render_modes": ["rgb_array"],
            "render_fps": max(1, round(1 / prepared.plant.period)),
            "autoreset_mode": self._mode,
        }
        self.render_mode = render_mode
        self._renderer = GhostRenderer(prepared.plant.model, width, height, camera)
        check_switch("ghost", ghost)
        self._ghost = ghost and estimator is not None
        self._episodes = Episodes(num_envs)
        self._ended = np.zeros(num_envs, bool)
        self._started = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start episodes in all rows, or in those of `options["reset_mask"]`.

        Args:
            seed: an integer s (row i gets s + i), one per row, or None.
            options: `reset_mask` `(num_envs,)` of bool; the filters of these rows begin anew too.

        Returns:
            Observations `(num_envs, k)`, and infos that are valid for the rows that were reset.
        """
        if self.closed:
            raise not_running(True)
        seeds = row_seeds(seed, self.num_envs)
        if isinstance(seed, int):
            super().reset(seed=seed)
        mask = reset_mask(options, self.num_envs)
        if not self._started and not mask.all():
            raise EnvError("reset_mask leaves out rows that have not started; reset all rows first")
        for row in np.flatnonzero(mask).tolist():
            self._episodes.seed(row, seeds[row])
        self._restart(mask)
        self._started = True
        return self._observe(self.world.x), self._info(mask)

    def step(self, actions: Array) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """One control period of all rows under actions `(num_envs, nu)`.

        Raises:
            EnvError: an action is outside the space, nothing was reset, or, without autoreset, an
                episode is over.
        """
        if not self._started or self.closed:
            raise not_running(self.closed)
        u = self._actions.controls(actions, self.num_envs)
        if self._mode is AutoresetMode.DISABLED and self._ended.any():
            raise EnvError(
                f"step() after the end of the episode of row {int(self._ended.argmax())}; call "
                "reset(options={'reset_mask': terminated | truncated}), or use another "
                "autoreset_mode"
            )
        again = self._ended if self._mode is AutoresetMode.NEXT_STEP else None
        if again is None or not again.any():
            reward, ended, late = self.world.step(u)
        else:
            reward, ended, late = self.world.step(u, ~again)
            self._restart(again)
        over = ended | late
        every = np.ones(self.num_envs, bool)
        if self._mode is AutoresetMode.SAME_STEP and over.any():
            final = self._observe(self.world.x), self._info(over)
            self._restart(over)
            info = self._info(every)
            add_final(info, over, *final)
        else:
            self._ended = over
            info = self._info(every)
        return self._observe(self.world.x), reward, ended, late, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture `(height, width, 3)` of every row, in mode `rgb_array`."""
        if self.render_mode is None:
            return None
        frames = []
        for row, x in enumerate(self.world.x):
            belief = self.world.belief(row) if self._ghost else None
            frames.append(self._renderer.render(self.render_mode, x, belief))
        return tuple(frames)

    def close_extras(self, **kwargs: Any) -> None:
        """Release the renderer and the backends."""
        self._renderer.close()
        self.world.close()

    def _restart(self, mask: Mask) -> None:
        rows = np.flatnonzero(mask)
        self.world.reset(rows, *self._episodes.next(rows))
        self._ended = self._ended & ~mask

    def _info(self, mask: Mask) -> dict[str, Any]:
        return vector_info(self.world.info(), mask)
