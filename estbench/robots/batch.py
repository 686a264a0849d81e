"""The backend on MuJoCo's own batch: every state is one row of a `mujoco.batch.Batch`.

This is the only file that imports `mujoco.batch`. A row that cannot be computed (not finite, too
large, an engine error) is NaN in the result; MuJoCo itself would reset it without an error.
"""

import math
from typing import Any, get_args

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from estbench.errors import ScenarioError
from estbench.robots import flags, library
from estbench.shapes import Array, Float, Int, Mask
from estbench.spaces.linalg import surely_finite

_BAD_STATE = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADCTRL) + 1)


class BatchBackend:
    """The `backend.Backend` on MuJoCo's own batch; one `Batch` is kept for each number of rows.

    Args:
        model: with the flags of `flags.set_flags`.
        nthread: number of threads of a batch; the results do not depend on it.

    Raises:
        ScenarioError: the model has a feature that a batch does not support.
    """

    def __init__(self, model: mujoco.MjModel, nthread: int = 1):
        self.model = model
        self.nthread = nthread
        self.nx = model.nq + model.nv + model.na
        self.rest = np.concatenate([model.qpos0, np.zeros(model.nv + model.na)])
        self._batches: dict[tuple[int, flags.Use], Batch] = {}
        self._models: dict[flags.Use, mujoco.MjModel] = {}
        # Of each call of `vary`, the last: what a copy is given again.
        self._varied: dict[tuple[int, str, str], tuple[int | slice, Array]] = {}
        self._settings = library.hold(self)
        try:
            probe = Batch(model, 1, 1)
        except ValueError as error:  # a feature whose memory is not part of the state
            reason = " ".join(str(error).split())
            raise ScenarioError(f"MuJoCo cannot step this model in a batch: {reason}") from None
        address = probe.state.ctypes.data

        def columns(field: str, width: int) -> slice:
            if not width:
                return slice(0, 0)
            start = (probe.bind(field).ctypes.data - address) // 8
            return slice(start, start + width)

        # In a row of the state qpos, qvel and act are consecutive: x is one block of columns.
        self._x = columns("qpos", self.nx)
        self._time = columns("time", 1)
        self._ctrl = columns("ctrl", model.nu)
        self._force = columns("qfrc_applied", model.nv)

    def batch(self, count: int, use: flags.Use = "step") -> Batch:
        """The batch of `count` rows for a use; its applied forces are zero."""
        if (count, use) not in self._batches:
            if use not in self._models:
                self._models[use] = flags.reduced(self.model, use)
            batch = Batch(self._models[use], count, self.nthread)
            if use != "step":
                batch.bind("sensordata")
            self._batches[count, use] = batch
        return self._batches[count, use]

    def __getstate__(self) -> dict[str, Any]:
        """What a copy is made of: it has batches of its own, which remember nothing."""
        return {"model": self.model, "nthread": self.nthread, "varied": self._varied}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["model"], state["nthread"])
        for (count, field, _), (index, values) in state["varied"].items():
            self.vary(count, field, index, values)

    def close(self) -> None:
        """Restore the settings of the MuJoCo library, unless another backend is open."""
        self._settings()

    def vary(
        self, count: int, field: str, index: int | slice, values: Float[Array, "count ..."]
    ) -> None:
        """See `Backend.vary`."""
        if not self._varied:  # the parameter may enable a constraint
            self._models, self._batches = dict.fromkeys(get_args(flags.Use), self.model), {}
        self._varied[count, field, repr(index)] = index, np.array(values)
        for use in self._models:
            batch = self.batch(count, use)
            batch.expand(field)[:, index] = values
            batch.set_const()

    def step(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        nstep: int,
        force: Float[Array, "... nv"] | None = None,
    ) -> Float[Array, "*lead nx"]:
        """See `Backend.step`."""
        batch, rows, bad = self._load(x, u, t, "step")
        if force is not None:
            rows[..., self._force] = force
        bad = self._run(batch, bad, nstep, 0)
        out = rows[..., self._x].copy()
        if force is not None:
            rows[..., self._force] = 0.0
        if bad is not None:
            out.reshape(-1, self.nx)[bad] = np.nan
        return out

    def read(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        stage: int,
        columns: Int[NDArray[np.intp], " m"],
        force: Float[Array, "... nv"] | None = None,
    ) -> Float[Array, "*lead m"]:
        """See `Backend.read`."""
        slow = stage <= int(mujoco.mjtStage.mjSTAGE_VEL)
        batch, rows, bad = self._load(x, u, t, "velocity" if slow else "acceleration")
        if force is not None:
            rows[..., self._force] = force
        bad = self._run(batch, bad, 0, stage)
        out = batch.bind("sensordata")[:, columns]
        if force is not None:
            rows[..., self._force] = 0.0
        if bad is not None:
            out[bad] = np.nan
        return out.reshape(*x.shape[:-1], len(columns))

    def flow(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        force: Float[Array, "... nv"] | None = None,
    ) -> Float[Array, "*lead n"]:
        """See `Backend.flow`."""
        batch, rows, bad = self._load(x, u, t, "step")
        derived = [batch.bind(name) for name in ("qacc", "act_dot")[: 1 + bool(self.model.na)]]
        if force is not None:
            rows[..., self._force] = force
        bad = self._run(batch, bad, 0, int(mujoco.mjtStage.mjSTAGE_ACC))
        velocity = batch.state[:, self._x][:, self.model.nq : self.model.nq + self.model.nv]
        out = np.concatenate([velocity, *derived], axis=-1)
        if force is not None:
            rows[..., self._force] = 0.0
        if bad is not None:
            out[bad] = np.nan
        return out.reshape(*x.shape[:-1], out.shape[-1])

    def _load(
        self, x: Array, u: Array, t: float | Array, use: flags.Use
    ) -> tuple[Batch, Array, Mask | None]:
        """Write states and controls; a row that is not finite is set to rest and is in the mask."""
        lead = x.shape[:-1]
        batch = self.batch(math.prod(lead), use)
        rows = batch.state.reshape(*lead, -1)
        bad = None
        if not surely_finite(x):
            broken = ~np.isfinite(x).all(axis=-1)
            if broken.any():
                x = np.where(broken[..., None], self.rest, x)
                bad = broken.ravel()
        rows[..., self._x] = x
        rows[..., self._time] = t
        if self.model.nu:
            rows[..., self._ctrl] = u if u.ndim == x.ndim else u[:, None]
        return batch, rows, bad

    def _run(self, batch: Batch, bad: Mask | None, nstep: int, stage: int) -> Mask | None:
        """Step, or compute forward stages; the mask of the rows without a result, or None."""
        failed: Mask | None = None
        try:
            if nstep:
                batch.step(nstep=nstep)
            else:
                batch.forward(stage=stage)
        except SimulationError as error:
            failed = np.zeros(batch.nsim, bool)
            failed[error.ids] = True
        warned = batch.warning[:, _BAD_STATE, 1]
        if np.count_nonzero(warned):
            blown = warned.any(axis=1)
            failed = blown if failed is None else failed | blown
            batch.warning[...] = 0
        if bad is None or failed is None:
            return bad if failed is None else failed
        return bad | failed
