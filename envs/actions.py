"""From a policy's action to the controls of the actuators, and the checks on the way."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from estbench.envs.errors import EnvError, check_switch
from estbench.envs.features import LIMIT
from estbench.robots.layout import control_names
from estbench.shapes import Array
from estbench.spaces.linalg import surely_finite


class Actions:
    """u = centre + scale · action.

    Args:
        model: compiled MuJoCo model.
        normalize: whether an actuator's ctrlrange is scaled to [-1, 1]; one without a ctrlrange is
            always taken in its own unit.

    Attributes:
        space: of one row's action `(nu,)`, float32.
    """

    def __init__(self, model: mujoco.MjModel, normalize: bool = True):
        check_switch("normalize_actions", normalize)
        limited = model.actuator_ctrllimited.astype(bool)
        low = np.where(limited, model.actuator_ctrlrange[:, 0], -LIMIT)
        high = np.where(limited, model.actuator_ctrlrange[:, 1], LIMIT)
        scaled = limited & normalize
        self._centre = np.where(scaled, 0.5 * (low + high), 0.0)
        self._scale = np.where(scaled, 0.5 * (high - low), 1.0)
        self._names = control_names(model)
        self.space = spaces.Box(
            np.where(scaled, -1.0, low).astype(np.float32),
            np.where(scaled, 1.0, high).astype(np.float32),
            dtype=np.float32,
        )

    def controls(self, actions: NDArray[Any], rows: int | None = None) -> Array:
        """Controls `(row, nu)` of actions `(row, nu)` in the space; without `rows`, of one `(nu,)`.

        Raises:
            EnvError: another shape, or a value outside the space.
        """
        values = np.asarray(actions, np.float64)
        axes = (len(self._names),)
        check(values, self.space, axes if rows is None else (rows, *axes), self._names)
        return self._centre + self._scale * values

    def actions(self, controls: Array) -> NDArray[np.float32]:
        """The actions `(..., nu)` that give these controls `(..., nu)`, clipped to the space."""
        values = (controls - self._centre) / self._scale
        return np.clip(values, self.space.low, self.space.high).astype(np.float32)


def check_finite(values: Array, shape: tuple[int, ...]) -> None:
    """Raise unless an action is of a shape and finite.

    Raises:
        EnvError: it is not.
    """
    if values.shape != shape:
        raise EnvError(f"action has shape {values.shape}; expected {shape}")
    if not surely_finite(values) and not np.isfinite(values).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise EnvError(f"action{list(where)} is {values[where]}; use a finite number")


def check(
    values: Array, space: spaces.Box, shape: tuple[int, ...], names: Sequence[str] = ()
) -> None:
    """Raise unless an action is of a shape and inside the bounds (to float32 rounding).

    Raises:
        EnvError: it is not.
    """
    check_finite(values, shape)
    inside = (values >= space.low) & (values <= space.high)
    if np.count_nonzero(inside) == inside.size:  # a third of `all()`'s time
        return
    slack = 1e-6 * np.maximum(1.0, np.abs(values))  # float32 rounding
    inside = (values >= space.low - slack) & (values <= space.high + slack)
    if not inside.all():
        where = tuple(int(i) for i in np.argwhere(~inside)[0])
        i = where[-1]
        name = f" ({names[i]})" if len(names) > i else ""
        raise EnvError(
            f"action{list(where)}{name} is {values[where]:g}; expected a value in "
            f"[{space.low[i]:g}, {space.high[i]:g}]; clip it, for example with "
            "gymnasium.wrappers.ClipAction"
        )
