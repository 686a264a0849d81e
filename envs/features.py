"""What a policy observes: the estimate, the belief, raw readings, or the truth."""

from dataclasses import dataclass
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


@dataclass(eq=False)
class Features:
    """What is observed of all rows.

    `state` is x̂ (qpos, qvel, act); `belief` appends the standard deviation of each tangent
    coordinate, `covariance` the upper triangle of P, row by row; `raw` is every channel's last
    noisy reading; `truth` is x.

    Args:
        observe: one of these kinds.
        suite: the sensors.
        filter: the beliefs of the robots, or None.
        nx: numbers of a state.

    Attributes:
        space: the observation space of one row.

    Raises:
        EnvError: `observe` is unknown, or it needs a filter and there is none.
    """

    observe: str
    suite: SensorSuite
    filter: LiveFilter | None
    nx: int

    def __post_init__(self) -> None:
        if self.observe not in get_args(Observe):
            hint = did_you_mean(self.observe, get_args(Observe))
            raise EnvError(f"observe is '{self.observe}'{hint}")
        if self.observe in ("raw", "truth"):
            self._last = np.zeros((len(self.suite.latest), self.nx))
            self.space = _box(self.suite.space.nx if self.observe == "raw" else self.nx)
            return
        if self.filter is None:
            raise EnvError(
                f"observe='{self.observe}' needs a filter; name an estimator, e.g. 'ekf'"
            )
        n = self.filter.space.n
        self._upper = np.triu_indices(n)
        more = {"state": 0, "belief": n, "covariance": n * (n + 1) // 2}
        self.space = _box(self.nx + more[self.observe])

    def __call__(self, x: Array) -> Array:
        """A new array `(row, k)` inside the space, from the true states `(row, nx)`."""
        if self.observe == "raw":
            return _inside(self.suite.latest)
        if self.observe == "truth":
            finite = np.isfinite(x)
            self._last[finite] = x[finite]
            return _inside(self._last)
        assert self.filter is not None
        mean, cov = self.filter.estimate, self.filter.cov
        if self.observe == "state":
            return _inside(mean)
        if self.observe == "belief":
            more = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
        else:
            more = cov[:, *self._upper]
        return _inside(np.concatenate([mean, more], axis=1))


def _box(width: int) -> spaces.Box:
    return spaces.Box(-LIMIT, LIMIT, (width,), np.float64)


def _inside(values: Array) -> Array:
    return np.minimum(np.maximum(values, -LIMIT), LIMIT)  # a fifth of np.clip's time
