"""The true state in `info`, for a vector of environments in other processes."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from estbench.envs.copies import carried, restore
from estbench.envs.member import Member
from estbench.envs.place import Given, Place
from estbench.robots.fields import Fields

STATE, MODEL = "estbench_state", "estbench_model"


@dataclass(frozen=True, eq=False)
class Sent:
    """The fields of a model; one object, which Gymnasium does not take apart by rows."""

    fields: Fields


class RecordTruth(gym.Wrapper, RecordConstructorArgs):
    """Adds state and inputs of a MuJoCo environment to `info`, and its model where that changes.

    `VectorEstimatedObservation` reads them from `info`: give this as one of `wrappers` to
    `gymnasium.make_vec`. It needs them for same-step autoreset, and they are the fastest way from
    the processes of an `AsyncVectorEnv`.

    Args:
        env: the environment.
        model, data: where they are, as for `estbench.envs.EstimatedObservation`.
    """

    def __init__(self, env: gym.Env, model: Given = "follow", data: Given = None):
        RecordConstructorArgs.__init__(self, model=model, data=data)
        gym.Wrapper.__init__(self, env)
        self._place = Place(env, model, data)
        self._member = Member(env, self._place)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As the environment, with the state in `info`."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._member.begin()
        return observation, {**info, **self._record()}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment, with the state in `info`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, **self._record()}

    def _record(self) -> dict[str, Any]:
        changes = self._member.changes()
        model = {} if changes is None else {MODEL: Sent(changes)}
        return {STATE: self._member.state(), **model}

    def __getstate__(self) -> dict[str, Any]:
        """The wrapper, and what a copy of the environment lacks."""
        state = {name: value for name, value in vars(self).items() if name != "_member"}
        pending = self._member.pending()
        return {"state": state, "carried": carried(self.env), "pending": pending}

    def __setstate__(self, copied: dict[str, Any]) -> None:
        vars(self).update(copied["state"])
        restore(self.env, copied["carried"])
        self._member = Member(self.env, self._place, copied["pending"])
