"""stable-baselines3's `VecEnv` over the native vector environment; comes with the extra `sb3`.

>>> from estbench.envs.sb3 import BatchVecEnv
>>> PPO("MlpPolicy", BatchVecEnv("estbench/CartPole-v0", 256)).learn(100_000)  # doctest: +SKIP
"""

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import estbench.envs  # noqa: F401  (registers the environments)
from estbench.envs.errors import EnvError
from estbench.envs.vector import ScenarioVectorEnv
from estbench.errors import MissingExtraError
from estbench.shapes import Array

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    raise MissingExtraError("stable-baselines3", "sb3") from None


class BatchVecEnv(VecEnv):
    """All rows in a few batch calls, with the interface of stable-baselines3.

    Args:
        env: id of a native environment, or a `ScenarioVectorEnv` with same-step autoreset.
        num_envs: how many rows, for an id.
        infos: whether every step's info is handed out by row; otherwise only what an algorithm
            needs (`terminal_observation`, `TimeLimit.truncated`), which is quicker.
        **kwargs: of `estbench.envs.vector.ScenarioVectorEnv`, for an id.

    Raises:
        EnvError: the environment is of another kind.
        EstbenchError: anything that does not fit.
    """

    def __init__(
        self,
        env: str | ScenarioVectorEnv,
        num_envs: int = 1,
        infos: bool = False,
        **kwargs: Any,
    ):
        if isinstance(env, str):
            made = gym.make_vec(env, num_envs, autoreset_mode="SameStep", **kwargs)
        else:
            made = env
        if not isinstance(made, ScenarioVectorEnv):
            raise EnvError(
                f"{type(made).__name__} is not estbench's vector environment; use an id such as "
                "'estbench/CartPole-v0', or stable_baselines3's make_vec_env for other ones"
            )
        if made.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise EnvError(
                f"autoreset_mode is '{made.metadata['autoreset_mode'].value}'; stable-baselines3 "
                "needs autoreset_mode='SameStep'"
            )
        self.env, self._infos = made, infos
        self._actions = np.zeros(made.action_space.shape or ())
        super().__init__(made.num_envs, made.single_observation_space, made.single_action_space)

    def reset(self) -> Array:
        """Start all rows, with the seeds that `seed()` set; observations `(num_envs, k)`."""
        given = any(seed is not None for seed in self._seeds)
        observations, info = self.env.reset(seed=list(self._seeds) if given else None)
        self.reset_infos = self._rows(info)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions `(num_envs, nu)` of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all rows; those that ended show the first observation of the next episode."""
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        over = terminated | truncated
        rows = self._rows(info)
        for row in np.flatnonzero(over):
            rows[row]["terminal_observation"] = info["final_obs"][row]
            rows[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
        return observations, rewards, over, rows

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A picture of every row."""
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The environment's attribute, once per row asked for."""
        return [getattr(self.env, attr_name)] * len(self._chosen(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused for single rows: all rows are one environment."""
        if len(self._chosen(indices)) < self.num_envs:
            raise EnvError(f"set_attr('{attr_name}') of some rows: all rows are one environment")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """The result of the environment's method, once per row asked for."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result] * len(self._chosen(indices))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No row is wrapped."""
        return [False] * len(self._chosen(indices))

    def _chosen(self, indices: int | Iterable[int] | None) -> list[int]:
        return list(self._get_indices(indices))

    def _rows(self, info: dict[str, Any]) -> list[dict[str, Any]]:
        """Infos by row: Gymnasium's are by key."""
        if not self._infos:
            return [{} for _ in range(self.num_envs)]
        keys = [k for k in info if not k.startswith(("_", "final_"))]
        return [{k: info[k][row] for k in keys} for row in range(self.num_envs)]
