"""What a policy is shown of the filter: the estimate, the belief, or raw readings."""

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from gymnasium import spaces

from estbench.envs.errors import EnvError
from estbench.envs.observer import Observer
from estbench.errors import did_you_mean
from estbench.shapes import Array

Observe = Literal["state", "belief", "covariance", "raw", "truth"]
LIMIT = 1e10
"""MuJoCo's mjMAXVAL: a state beyond it is an error, so nothing observed is outside ± this."""


def features(observe: str, observer: Observer) -> tuple[spaces.Box, Callable[[Array], Array]]:
    """The observation space of one row, and the function of the true states that observes all.

    `state` is x̂ (qpos, qvel, act); `belief` appends the standard deviation of each tangent
    coordinate, `covariance` the upper triangle of P, row by row; `raw` is every channel's last
    noisy reading; `truth` is x.

    Args:
        observe: one of these.
        observer: sensors and filters.

    Returns:
        The space, and `(row, nx)` -> new array `(row, k)` inside it.

    Raises:
        EnvError: unknown, or it needs a filter and there is none.
    """
    if observe not in get_args(Observe):
        raise EnvError(f"observe is '{observe}'{did_you_mean(observe, get_args(Observe))}")
    bank = observer.bank
    if observe == "raw":
        return _box(observer.readings.space.nx), lambda x: _inside(observer.readings.last)
    if observe == "truth":
        nx = observer.model.nq + observer.model.nv + observer.model.na
        last = np.zeros((len(observer.readings.tick), nx))

        def truth(x: Array) -> Array:
            finite = np.isfinite(x)
            last[finite] = x[finite]
            return _inside(last)

        return _box(nx), truth
    if bank is None:
        raise EnvError(f"observe='{observe}' needs a filter; name an estimator, e.g. 'ekf'")
    nx, n = bank.space.nx, bank.space.n
    if observe == "state":
        return _box(nx), lambda x: _inside(bank.estimate)
    if observe == "belief":

        def belief(x: Array) -> Array:
            variance = np.diagonal(bank.cov, axis1=1, axis2=2)
            std = np.sqrt(np.maximum(variance, 0.0))
            return _inside(np.concatenate([bank.estimate, std], axis=1))

        return _box(nx + n), belief
    upper = np.triu_indices(n)

    def covariance(x: Array) -> Array:
        return _inside(np.concatenate([bank.estimate, bank.cov[:, *upper]], axis=1))

    return _box(nx + n * (n + 1) // 2), covariance


def _box(width: int) -> spaces.Box:
    return spaces.Box(-LIMIT, LIMIT, (width,), np.float64)


def _inside(values: Array) -> Array:
    return np.minimum(np.maximum(values, -LIMIT), LIMIT)  # a fifth of np.clip's time
