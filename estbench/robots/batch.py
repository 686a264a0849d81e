"""The backend on MuJoCo's own batch: every state is one row of a `mujoco.batch.Batch`.

This is the only file that imports `mujoco.batch`. A row that cannot be computed (not finite, too
large, an engine error) is NaN in the result; MuJoCo itself would reset it without an error.
"""

import math
import re
import time
from collections.abc import Sequence
from typing import Any, get_args

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from estbench.errors import ScenarioError
from estbench.robots import flags, given, library, sharing, unlocked
from estbench.shapes import Array, Float, Int, Mask
from estbench.spaces.linalg import surely_finite

_NO_MEMORY = re.compile("unknown exception|bad_alloc|allocate", re.IGNORECASE)
_BAD_STATE = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADCTRL) + 1)


def _made(model: mujoco.MjModel, count: int, nthread: int) -> Batch:
    """A batch of `count` rows.

    Raises:
        ValueError: the model has a feature that a batch does not support.
        MemoryError: there is no memory for it; MuJoCo says so in other words.
    """
    try:
        return Batch(model, count, nthread)
    except RuntimeError as error:
        if not _NO_MEMORY.search(str(error)):
            raise
        raise MemoryError(f"MuJoCo finds none for {count} simulations") from None


class BatchBackend:
    """The `backend.Backend` on MuJoCo's own batch; one `Batch` is kept for each number of rows.

    Args:
        model: with the flags of `flags.set_flags`.
        nthread: number of threads of a batch, on which the results do not depend. None: as many of
            the cores as make a call faster (see `sharing`), for a robot that has them for itself.

    Raises:
        ScenarioError: the model has a feature that a batch does not support.
    """

    def __init__(self, model: mujoco.MjModel, nthread: int | None = 1):
        self.model = model
        self.nthread = nthread
        cores = sharing.free_cores() if nthread is None else 1
        self._threads = sharing.Threads(cores) if cores > 1 else None
        if nthread != 1:
            sharing.tell_of_forks(self)
        self.nx = model.nq + model.nv + model.na
        self.rest = np.concatenate([model.qpos0, np.zeros(model.nv + model.na)])
        self._batches: dict[tuple[int, flags.Use], Batch] = {}
        self._models: dict[flags.Use, mujoco.MjModel] = {}
        # Of each call of `vary`, the last: what a copy is given again.
        self._varied: dict[tuple[int, str, str], tuple[int | slice, Array]] = {}
        self._settings = library.hold(self)
        try:
            probe = _made(model, 1, 1)
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
        # All inputs are consecutive too, the controls first.
        start = self._force.start - model.nu
        self._inputs = slice(start, start + given.size(model))
        self._at_rest = given.at_rest(model)
        self._others: dict[int, mujoco.MjModel] = {}
        self._reduced: dict[tuple[int, flags.Use], mujoco.MjModel] = {}
        self._numbers: dict[tuple[int, flags.Use], Array] = {}
        self._given = False  # whether all inputs were ever given
        self._paced: dict[int, float] = {}  # count of rows -> timestep, where that was ever changed

    def batch(self, count: int, use: flags.Use = "step") -> Batch:
        """The batch of `count` rows for a use; its applied forces are zero."""
        key = count, use
        nthread = (self.nthread or 1) if self._threads is None else self._threads.of(key)
        batch = self._batches.get(key)
        if batch is None or (self._threads is not None and batch.nthread != nthread):
            batch = self._batches[key] = self._new(count, use, nthread)
        return batch

    def _new(self, count: int, use: flags.Use, nthread: int) -> Batch:
        """A batch of the first model, with what `vary` was given."""
        if use not in self._models:
            self._models[use] = flags.reduced(self.model, use)
        batch = _made(self._models[use], count, nthread)
        self._numbers.pop((count, use), None)
        if use == "step":
            self._paced.pop(count, None)
        if self.model.nmocap:
            batch.state[:, self._inputs] = self._at_rest
        if use != "step":
            batch.bind("sensordata")
        for key in self._varied:
            if key[0] == count:
                self._differ(batch, key)
        return batch

    def _differ(self, batch: Batch, key: tuple[int, str, str]) -> None:
        """Give the rows what `vary` was given."""
        index, values = self._varied[key]
        batch.expand(key[1])[:, index] = values
        batch.set_const()

    def __getstate__(self) -> dict[str, Any]:
        """What a copy is made of: it has batches of its own, which remember nothing."""
        return {
            "model": self.model, "nthread": self.nthread,
            "varied": self._varied, "others": self._others,
        }  # fmt: skip

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["model"], state["nthread"])
        for (count, field, _), (index, values) in state["varied"].items():
            self.vary(count, field, index, values)
        self._others = state["others"]

    def forked(self) -> None:
        """See `sharing.Threaded`: from now on one thread."""
        for batch in self._batches.values():
            sharing.never_release(batch)
        self._batches, self._threads, self.nthread = {}, None, 1

    def close(self) -> None:
        """Restore the settings of the MuJoCo library, unless another backend is open."""
        self._settings()

    def vary(
        self, count: int, field: str, index: int | slice, values: Float[Array, "count ..."]
    ) -> None:
        """See `Backend.vary`."""
        if not self._varied:  # the parameter may enable a constraint
            self._models, self._batches = dict.fromkeys(get_args(flags.Use), self.model), {}
            self._paced.clear()
        key = count, field, repr(index)
        self._varied[key] = index, np.array(values)
        for batch in (b for (rows, _), b in self._batches.items() if rows == count):
            self._differ(batch, key)

    def follow(self, number: int, model: mujoco.MjModel | None) -> None:
        """See `Backend.follow`."""
        if model is not None:
            self._others[number] = model
            return
        self._others.pop(number, None)
        for use in get_args(flags.Use):
            self._reduced.pop((number, use), None)

    def step(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        nstep: int,
        force: Float[Array, "... nv"] | None = None,
        timestep: float | None = None,
    ) -> Float[Array, "*lead nx"]:
        """See `Backend.step`."""
        batch, rows, bad = self._load(x, u, t, "step")
        if timestep is not None or self._paced:
            self._pace(batch, timestep or self.model.opt.timestep)
        if force is not None:
            rows[..., self._force] += force
        bad = self._run(batch, "step", bad, nstep, 0)
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
        use: flags.Use = "velocity" if slow else "acceleration"
        batch, rows, bad = self._load(x, u, t, use)
        if force is not None:
            rows[..., self._force] += force
        bad = self._run(batch, use, bad, 0, stage)
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
            rows[..., self._force] += force
        bad = self._run(batch, "step", bad, 0, int(mujoco.mjtStage.mjSTAGE_ACC))
        velocity = batch.state[:, self._x][:, self.model.nq : self.model.nq + self.model.nv]
        out = np.concatenate([velocity, *derived], axis=-1)
        if force is not None:
            rows[..., self._force] = 0.0
        if bad is not None:
            out[bad] = np.nan
        return out.reshape(*x.shape[:-1], out.shape[-1])

    def frames(
        self, x: Float[Array, "run nx"], fields: Sequence[str]
    ) -> tuple[Float[Array, "run k 3"], ...]:
        """See `Backend.frames`."""
        batch, _, bad = self._load(x, np.zeros((len(x), self.model.nu)), 0.0, "velocity")
        views = [batch.bind(name) for name in fields]
        bad = self._run(batch, "velocity", bad, 0, int(mujoco.mjtStage.mjSTAGE_POS))
        out = tuple(view.copy() for view in views)
        for values in out if bad is not None else ():
            values[bad] = np.nan
        return out

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
        u = u if u.ndim == x.ndim else u[:, None]
        if self._given or u.shape[-1] != self.model.nu:
            self._give(batch, rows, u, use)
        elif self.model.nu:
            rows[..., self._ctrl] = u
        return batch, rows, bad

    def _pace(self, batch: Batch, timestep: float) -> None:
        """Let the physics steps of a batch have this length.

        Raises:
            ScenarioError: its rows run on models of others.
        """
        if self._paced.get(batch.nsim, self.model.opt.timestep) == timestep:
            return
        if self._others:
            raise ScenarioError("a robot whose models change cannot have steps of other lengths")
        batch.expand("opt.timestep")[:] = timestep
        self._paced[batch.nsim] = timestep

    def _give(self, batch: Batch, rows: Array, u: Array, use: flags.Use) -> None:
        """Write all inputs, and give each row its model; see `given`."""
        lead, self._given = rows.shape[:-1], True
        key: tuple[int, flags.Use] = batch.nsim, use
        numbers = np.zeros(batch.nsim)
        if u.shape[-1] == self.model.nu:
            rows[..., self._inputs] = self._at_rest
            rows[..., self._ctrl] = u
        else:
            rows[..., self._inputs] = u[..., :-1]
            numbers[:] = np.broadcast_to(u[..., -1], lead).ravel()
        before = self._numbers.get(key)
        if not np.count_nonzero(numbers if before is None else numbers != before):
            return
        known = {n: self._model(n, use) for n in np.unique(numbers).astype(int).tolist()}
        one = next(iter(known.values())) if len(known) == 1 else None
        batch.set_models(one or [known[n] for n in numbers.astype(int).tolist()])
        self._numbers[key] = numbers

    def _model(self, number: int, use: flags.Use) -> mujoco.MjModel:
        """The model of a number, without what the use does not need."""
        if number == 0:
            return self._models[use]
        if (number, use) not in self._reduced:
            self._reduced[number, use] = flags.reduced(self._others[number], use)
        return self._reduced[number, use]

    def _run(
        self, batch: Batch, use: flags.Use, bad: Mask | None, nstep: int, stage: int
    ) -> Mask | None:
        """Step, or compute forward stages; the mask of the rows without a result, or None."""
        failed: Mask | None = None
        began, counted = time.perf_counter(), unlocked.begin()
        try:
            if nstep:
                batch.step(nstep=nstep)
            else:
                batch.forward(stage=stage)
        except SimulationError as error:
            failed = np.isin(np.arange(batch.nsim), error.ids)
        unlocked.end(counted)
        if self._threads is not None:
            self._threads.took((batch.nsim, use), began, time.perf_counter())
        warned = batch.warning[:, _BAD_STATE, 1]
        if np.count_nonzero(warned):
            blown = warned.any(axis=1)
            failed = blown if failed is None else failed | blown
            batch.warning[...] = 0
        if bad is None or failed is None:
            return bad if failed is None else failed
        return bad | failed
