"""Copies of environments of other libraries that go on as the original does.

Gymnasium's MuJoCo environments are `EzPickle`: their copy is a new environment, made with the same
arguments, in another state. What a copy lacks is carried beside it and put back, also for an
environment inside another.
"""

from typing import Any

import gymnasium as gym
from gymnasium.utils import EzPickle

from estbench.envs.parts import Path, at, walk

_OWN = ("mujoco_renderer", "spec", "_ezpickle_args", "_ezpickle_kwargs")


def carried(env: gym.Env) -> dict[Path, dict[str, Any]]:
    """The attributes that a copy of an environment is to have: model, data, generator, goal.

    They are those of the environment, and of each part whose copy would be a new one.
    """
    base = env.unwrapped
    inside = {path: part for path, part in walk(base) if isinstance(part, EzPickle)}
    return {
        path: {name: value for name, value in vars(part).items() if name not in _OWN}
        for path, part in {(): base, **inside}.items()
    }


def restore(env: gym.Env, attributes: dict[Path, dict[str, Any]]) -> None:
    """Give a copied environment what was carried."""
    for path, values in attributes.items():  # what is inside comes after what it is in
        part: Any = at(env.unwrapped, path)
        vars(part).update(values)
        renderer = getattr(part, "mujoco_renderer", None)
        if renderer is not None:
            renderer.model, renderer.data = part.model, part.data
