"""One environment of another library: its true state, inputs and model, as they are now."""

from typing import Any

import mujoco
import numpy as np

from estbench.envs.errors import EnvError
from estbench.envs.place import Place
from estbench.robots import fields
from estbench.robots.fields import Fields
from estbench.robots.given import INPUTS, STATE
from estbench.shapes import Array

_WHOLE = STATE | INPUTS
_BAD_STATE = tuple(
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")
)


class Member:
    """An environment, which is only read.

    Args:
        env: the environment.
        place: where its model and data are.
        pending: whether nobody knows the fields of the model yet.

    Attributes:
        env, model, data: the environment, and its MuJoCo model and data as of the last `begin`.
    """

    def __init__(self, env: Any, place: Place, pending: bool = True):
        self.env, self._place = env, place
        self.model, self.data = place.find(env)
        self._new, self._looked = pending, fields.Looked(self.model)
        self._size = mujoco.mj_stateSize(self.model, _WHOLE)

    def begin(self) -> None:
        """An episode begins: the environment may have made another model, or other data."""
        model, data = self._place.find(self.env)
        if model is not self.model:
            self._looked = fields.Looked(model)
            self._size = mujoco.mj_stateSize(model, _WHOLE)
        self._new |= model is not self.model or self._looked.again(thorough=True)
        self.model, self.data = model, data

    def pending(self) -> bool:
        """Whether the fields of the model are not those of the last call of `changes`."""
        self._new |= self._looked.again()
        return self._new

    def changes(self) -> Fields | None:
        """All fields of the model, if they are not those of the last call; else None."""
        if not self.pending():
            return None
        self._new = False
        return fields.read(self.model)

    def state(self) -> Array:
        """Time, qpos, qvel, act and all inputs (see `robots.given`), one after the other."""
        out = np.empty(self._size)
        mujoco.mj_getState(self.model, self.data, out, _WHOLE)
        return out

    def check_not_reset(self) -> None:
        """Raise if MuJoCo has reset a state that was not finite or too large.

        In the first step of an episode `data.time` does not show it.

        Raises:
            EnvError: it has.
        """
        if any(self.data.warning[kind].number for kind in _BAD_STATE):
            raise EnvError(
                "MuJoCo reset the state in this step, since it was not finite or too large; the "
                "episode is void: call reset()"
            )


def state_of(data: mujoco.MjData) -> Array:
    """As `Member.state`, of data that came from another process with their model."""
    out = np.empty(mujoco.mj_stateSize(data.model, _WHOLE))
    mujoco.mj_getState(data.model, data, out, _WHOLE)
    return out
