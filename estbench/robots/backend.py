"""A physics engine behind a MuJoCo model: the protocol, and the one place where a backend is made.

Another engine is one more class with these methods, and one more case in `create`.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.robots.batch import BatchBackend
from estbench.shapes import Array, Float, Int


@runtime_checkable
class Backend(Protocol):
    """Steps, sensor readings and rates of many states of one MuJoCo model, row by row.

    A row is one state x = (qpos, qvel, act) of nx = nq + nv + na numbers. Every call is a function
    of its arguments: no row remembers the call before. Rows do not influence each other. A row that
    the engine cannot compute, or whose state is not finite, is NaN in the result.

    The leading axes of x are `(run,)` or `(run, point)`. A backend is not safe to share between
    threads.
    """

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model, with the flags of `flags.set_flags`."""
        ...

    @property
    def nx(self) -> int:
        """Length of a state, nq + nv + na."""
        ...

    def step(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        nstep: int,
        force: Float[Array, "... nv"] | None = None,
        timestep: float | None = None,
    ) -> Float[Array, "*lead nx"]:
        """States after `nstep` physics steps of the model's timestep.

        Args:
            x: states `(run, nx)` or `(run, point, nx)`.
            u: controls `(run, nu)` or `(run, point, nu)`, broadcast over the points; not clamped.
                Or all inputs and the number of a model: see `given`.
            t: time at the start, s; one number, or one per row `(run, 1)`.
            nstep: number of physics steps, at least 1.
            force: generalized forces, N or N m, broadcast over the leading axes and constant over
                the steps; None for none.
            timestep: length of each physics step, s; None for that of the model.
        """
        ...

    def read(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        stage: int,
        columns: Int[NDArray[np.intp], " m"],
        force: Float[Array, "... nv"] | None = None,
    ) -> Float[Array, "*lead m"]:
        """Noise-free sensor readings at x, in the units of the sensors, as the engine gives them.

        Args:
            x: as for `step`.
            u: as for `step`.
            t: as for `step`.
            stage: the last forward stage (`mjtStage`) that is computed; see
                `measurement.needed_stage`.
            columns: columns of `sensordata`.
            force: as for `step`.
        """
        ...

    def flow(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        force: Float[Array, "... nv"] | None = None,
    ) -> Float[Array, "*lead n"]:
        """Rates ẋ = (q̇, q̈, ȧ) at x by the complete forward dynamics, per s.

        q̇ of a ball or free joint is its body-frame angular velocity, as in the tangent space. The
        arguments are those of `step`.
        """
        ...

    def frames(
        self, x: Float[Array, "run nx"], fields: Sequence[str]
    ) -> tuple[Float[Array, "run k 3"], ...]:
        """Positions and axes at x, as copies: fields of `MjData` of three numbers per object.

        Args:
            x: states.
            fields: of the position stage, such as `site_xpos` (m), `xanchor` (m), `xaxis`.
        """
        ...

    def vary(
        self, count: int, field: str, index: int | slice, values: Float[Array, "count ..."]
    ) -> None:
        """Give each row its own value of a model parameter, in every later call of `count` rows.

        Args:
            count: number of rows.
            field: field of `MjModel`, e.g. `body_mass`.
            index: which of the field's elements.
            values: one value per row.
        """
        ...

    def follow(self, number: int, model: mujoco.MjModel | None) -> None:
        """Let rows run on another model: those whose u has its number (see `given`).

        Args:
            number: at least 1, below 2⁵³; one that was used before is not used again.
            model: of the same sizes, with the flags of `flags.set_flags`; None forgets it.
        """
        ...

    def close(self) -> None:
        """Release what the backend holds; garbage collection does the same."""
        ...


def create(model: mujoco.MjModel, nthread: int | None = 1) -> Backend:
    """A backend for a model.

    Args:
        model: compiled by `mjcf.compile_model`, or with the flags of `flags.set_flags`.
        nthread: number of threads that share the rows of a call; None for as many of the cores as
            make it faster (see `sharing`).
    """
    return BatchBackend(model, nthread)
