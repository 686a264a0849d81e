"""Copies of environments of other libraries that go on as the original does.

Gymnasium's MuJoCo environments are `EzPickle`: their copy is a new environment, made with the same
arguments, in another state. What a copy lacks is carried beside it and put back.
"""

from typing import Any

import gymnasium as gym

_OWN = ("mujoco_renderer", "spec", "_ezpickle_args", "_ezpickle_kwargs")


def carried(env: gym.Env) -> dict[str, Any]:
    """The attributes that a copy of an environment is to have: model, data, generator, goal."""
    return {name: value for name, value in vars(env.unwrapped).items() if name not in _OWN}


def restore(env: gym.Env, attributes: dict[str, Any]) -> None:
    """Give a copied environment what was carried."""
    base: Any = env.unwrapped
    vars(base).update(attributes)
    renderer = getattr(base, "mujoco_renderer", None)
    if renderer is not None:
        renderer.model, renderer.data = base.model, base.data
