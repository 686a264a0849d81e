"""The range of the controls: estbench clamps a control before the actuator noise is added to it."""

from dataclasses import dataclass

import mujoco
import numpy as np

from estbench.shapes import Array, Float


@dataclass(frozen=True, eq=False)
class ControlRange:
    """The `ctrlrange` of every actuator of a model, or of the model of each row.

    Attributes:
        low: lowest control; -inf where there is no limit.
        high: highest control; inf where there is no limit.
    """

    low: Float[Array, "*row nu"]
    high: Float[Array, "*row nu"]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "ControlRange":
        """The range that the model declares."""
        limited = model.actuator_ctrllimited.astype(bool)
        return cls(
            np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf),
            np.where(limited, model.actuator_ctrlrange[:, 1], np.inf),
        )

    def clamp(self, u: Float[Array, "*lead nu"]) -> Float[Array, "*lead nu"]:
        """Controls clipped to the range, as MuJoCo would clip them."""
        return np.minimum(np.maximum(u, self.low), self.high)
