"""The true state in `info`, for a vector of environments in other processes."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from estbench.envs.adopt import mujoco_parts

KEYS = ("estbench_x", "estbench_u", "estbench_t")


class RecordTruth(gym.Wrapper, RecordConstructorArgs):
    """Adds state, controls and time of a MuJoCo environment to `info`.

    `VectorEstimatedObservation` reads them from `info`: give this as one of `wrappers` to
    `gymnasium.make_vec`. It needs them for same-step autoreset, and they are the fastest way from
    the processes of an `AsyncVectorEnv`.
    """

    def __init__(self, env: gym.Env):
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        _, self._data = mujoco_parts(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As the environment, with the state in `info`."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, **self._record()}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment, with the state in `info`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, **self._record()}

    def _record(self) -> dict[str, Any]:
        data = self._data
        x = np.concatenate([data.qpos, data.qvel, data.act])
        return dict(zip(KEYS, (x, np.array(data.ctrl), float(data.time))))
