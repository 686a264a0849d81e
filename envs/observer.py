"""What is known of many robots: sensors and, if there is one, the filter bank that reads them."""

from typing import Any

import mujoco
import numpy as np

from estbench.envs.filter import FilterBank
from estbench.envs.keys import Keys, Mask
from estbench.envs.readings import Readings
from estbench.shapes import Array
from estbench.spaces.linalg import quiet


class Observer:
    """Follows true states with sensors and a filter bank.

    Args:
        model: the robot as its sensors see it.
        readings: its sensors.
        bank: the filters, or None for raw readings only.

    Attributes:
        t: time of the last states, s, since the reset of the row that has run longest.
    """

    def __init__(self, model: mujoco.MjModel, readings: Readings, bank: FilterBank | None):
        self.model, self.readings, self.bank = model, readings, bank
        self._timestep = float(model.opt.timestep)
        limited = model.actuator_ctrllimited.astype(bool)
        self._low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
        self._high = np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)
        self.t = 0.0

    def reset(self, mask: Mask, keys: Keys, x: Array, u: Array, mean: Array, cov: Array) -> None:
        """Start the rows of a mask anew.

        Args:
            mask: `(row,)`.
            keys: random keys of these rows `(mask.sum(),)`.
            x: true states of all rows `(row, nx)`.
            u: controls `(row, nu)`.
            mean: x̂₀ of all rows `(row, nx)`.
            cov: P₀ of all rows `(row, n, n)`.
        """
        self.readings.start(mask, keys, x, self._clamp(u))
        self.t = self.readings.latest * self._timestep
        if self.bank is not None:
            every = np.zeros(len(mask), np.uint64)
            every[mask] = keys
            with quiet():
                self.bank.reset(mask, mean, cov, every)

    def begin(self) -> None:
        """A new step of the environment begins."""
        if self.bank is not None:
            self.bank.begin()

    def advance(self, steps: int, x: Array, u: Array, mask: Mask | None = None) -> None:
        """Physics steps have passed under the controls u, up to the true states x.

        Args:
            steps: physics steps.
            x: `(row, nx)`.
            u: `(row, nu)`.
            mask: rows for which time passes; None is all.
        """
        u = self._clamp(u)
        with quiet():
            if self.bank is not None:
                self.bank.predict(u, self.t, steps * self._timestep, mask)
            arrived = self.readings.take(steps, x, u, mask)
            self.t = self.readings.latest * self._timestep
            if self.bank is not None:
                self.bank.fuse(arrived, u, self.t)
                self.bank.settle()

    def info(self, x: Array) -> dict[str, Any]:
        """What `info` says of every row: see `FilterBank.info`; without a filter, the truth."""
        if self.bank is None:
            return {"truth": x.copy()}
        with quiet():
            return self.bank.info(x)

    def _clamp(self, u: Array) -> Array:
        """As `models.mjcf.clamp`, the limits taken once."""
        return np.minimum(np.maximum(u, self._low), self._high)
