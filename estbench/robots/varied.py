"""A backend whose model has other parameters in each run, for any number of points per run."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.robots.backend import Backend
from estbench.shapes import Array, Float, Int


@dataclass(frozen=True, eq=False)
class Parameter:
    """One parameter, drawn.

    Attributes:
        field: of `MjModel`, e.g. `body_mass`.
        index: which of the field's elements.
        values: one value for each run.
    """

    field: str
    index: int | slice
    values: Float[Array, "run ..."]


class VariedBackend:
    """The `backend.Backend` of runs with parameters of their own.

    Args:
        inner: a backend that nothing else uses.
        parameters: that differ between the runs.
    """

    def __init__(self, inner: Backend, parameters: Sequence[Parameter]):
        self._inner, self._parameters = inner, tuple(parameters)
        self._known: set[int] = set()

    @property
    def model(self) -> mujoco.MjModel:
        """See `Backend.model`."""
        return self._inner.model

    @property
    def nx(self) -> int:
        """See `Backend.nx`."""
        return self._inner.nx

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
        self._prepare(x)
        return self._inner.step(x, u, t, nstep, force, timestep)

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
        self._prepare(x)
        return self._inner.read(x, u, t, stage, columns, force)

    def flow(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        force: Float[Array, "... nv"] | None = None,
    ) -> Float[Array, "*lead n"]:
        """See `Backend.flow`."""
        self._prepare(x)
        return self._inner.flow(x, u, t, force)

    def frames(
        self, x: Float[Array, "run nx"], fields: Sequence[str]
    ) -> tuple[Float[Array, "run k 3"], ...]:
        """See `Backend.frames`."""
        self._prepare(x)
        return self._inner.frames(x, fields)

    def vary(
        self, count: int, field: str, index: int | slice, values: Float[Array, "count ..."]
    ) -> None:
        """See `Backend.vary`."""
        self._inner.vary(count, field, index, values)

    def follow(self, number: int, model: mujoco.MjModel | None) -> None:
        """See `Backend.follow`."""
        self._inner.follow(number, model)

    def close(self) -> None:
        """See `Backend.close`."""
        self._inner.close()

    def _prepare(self, x: Array) -> None:
        """Give the rows of this many states their parameters, once."""
        count = math.prod(x.shape[:-1])
        if count in self._known:
            return
        self._known.add(count)
        for p in self._parameters:
            self._inner.vary(count, p.field, p.index, p.values.repeat(count // len(x), axis=0))
