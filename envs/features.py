"""What a policy observes: the estimate, the belief, raw readings, or the truth."""

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from gymnasium import spaces

from estbench.envs.errors import EnvError
from estbench.errors import did_you_mean
from estbench.inference.live import LiveFilter
from estbench.sensors.suite import SensorSuite
from estbench.shapes import Array

Observe = Literal["state", "belief", "covariance", "raw", "truth"]
LIMIT = 1e10
"""MuJoCo's mjMAXVAL: a state beyond it is an error, so nothing observed is outside ± this."""


def features(
    observe: str, suite: SensorSuite, filter_: LiveFilter | None, nx: int
) -> tuple[spaces.Box, Callable[[Array], Array]]:
    """The observation space of one row, and the function of the true states that observes all.

    `state` is x̂ (qpos, qvel, act); `belief` appends the standard deviation of each tangent
    coordinate, `covariance` the upper triangle of P, row by row; `raw` is every channel's last
    noisy reading; `truth` is x.

    Args:
        observe: one of these kinds.
        suite: the sensors.
        filter_: the beliefs of the robots, or None.
        nx: numbers of a state.

    Returns:
        The space, and `(row, nx)` -> new array `(row, k)` inside it.

    Raises:
        EnvError: `observe` is unknown, or it needs a filter and there is none.
    """
    if observe not in get_args(Observe):
        raise EnvError(f"observe is '{observe}'{did_you_mean(observe, get_args(Observe))}")
    if observe == "raw":
        return _box(suite.space.nx), lambda x: _inside(suite.latest)
    if observe == "truth":
        last = np.zeros((len(suite.latest), nx))

        def truth(x: Array) -> Array:
            finite = np.isfinite(x)
            last[finite] = x[finite]
            return _inside(last)

        return _box(nx), truth
    if filter_ is None:
        raise EnvError(f"observe='{observe}' needs a filter; name an estimator, e.g. 'ekf'")
    n = filter_.space.n
    if observe == "state":
        return _box(nx), lambda x: _inside(filter_.estimate)
    if observe == "belief":

        def belief(x: Array) -> Array:
            variance = np.diagonal(filter_.cov, axis1=1, axis2=2)
            std = np.sqrt(np.maximum(variance, 0.0))
            return _inside(np.concatenate([filter_.estimate, std], axis=1))

        return _box(nx + n), belief
    upper = np.triu_indices(n)

    def covariance(x: Array) -> Array:
        return _inside(np.concatenate([filter_.estimate, filter_.cov[:, *upper]], axis=1))

    return _box(nx + n * (n + 1) // 2), covariance


def _box(width: int) -> spaces.Box:
    return spaces.Box(-LIMIT, LIMIT, (width,), np.float64)


def _inside(values: Array) -> Array:
    return np.minimum(np.maximum(values, -LIMIT), LIMIT)  # a fifth of np.clip's time
