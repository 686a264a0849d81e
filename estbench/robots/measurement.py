"""The noise-free reading of a channel: from MuJoCo sensors, or from a function of the user."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.errors import ScenarioError, user_error_location
from estbench.robots import layout
from estbench.robots.backend import Backend
from estbench.robots.components import components
from estbench.robots.no_return import NoReturns
from estbench.shapes import Array, Float, Int
from estbench.spaces.manifold import Manifold, product

StateFunction = Callable[[Array, Array, float], Array]
"""h(x, u, t): state `(..., nx)`, control `(..., nu)`, time in s -> reading `(..., m)`; +inf for a
component without a return."""


@dataclass(frozen=True, eq=False)
class Measurand:
    """The noise-free reading of one channel.

    Attributes:
        space: the manifold of the reading.
        sensors: MuJoCo sensors whose readings are concatenated.
        axes: indices of the components that are read; None for all. Not those of a quaternion.
        function: a function of the state that replaces the sensors.
        name: name of the function, for messages.
    """

    space: Manifold
    sensors: tuple[int, ...] = ()
    axes: tuple[int, ...] | None = None
    function: StateFunction | None = None
    name: str = ""

    @classmethod
    def of_sensors(
        cls, model: mujoco.MjModel, *sensors: int, axes: Sequence[int] | None = None
    ) -> "Measurand":
        """The readings of MuJoCo sensors, or some components of them."""
        space = layout.sensor_space(model, sensors)
        if axes is None:
            return cls(space, sensors)
        names, units = (tuple(values[i] for i in axes) for values in (space.names, space.units))
        return cls(Manifold(names, units), sensors, tuple(axes))

    def columns(self, model: mujoco.MjModel) -> Int[NDArray[np.intp], " m"]:
        """Columns of `sensordata` that hold the reading."""
        columns = sensor_columns(model, self.sensors)
        return columns if self.axes is None else columns[list(self.axes)]

    def depends_on_time(self, model: mujoco.MjModel) -> bool:
        """Whether the reading depends on the time: a function, or a `clock` sensor."""
        clock = model.sensor_type[list(self.sensors)] == mujoco.mjtSensor.mjSENS_CLOCK
        return self.function is not None or bool(clock.any())

    def call(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float
    ) -> Float[Array, "*lead m"]:
        """Call the function and check the shape of its result.

        Raises:
            ScenarioError: the function raised, or returned another shape.
        """
        assert self.function is not None
        u = np.broadcast_to(u if u.ndim == x.ndim else u[:, None], (*x.shape[:-1], u.shape[-1]))
        try:
            y = np.asarray(self.function(x.copy(), u, t), dtype=np.float64)
        except (Exception, SystemExit) as error:  # a user's function may raise anything
            raise ScenarioError(
                f"{self.name} raised for x of shape {x.shape}: {user_error_location(error)}"
            ) from None
        expected = (*x.shape[:-1], self.space.nx)
        if y.shape != expected:
            raise ScenarioError(
                f"{self.name} returned shape {y.shape} for x of shape {x.shape}; expected "
                f"{expected}: index the state as x[..., i] and keep the last axis"
            )
        return y


class Plan:
    """How to read several channels together, with at most one call of the backend.

    A component without a return (see `no_return`) is +inf.

    Args:
        model: compiled MuJoCo model.
        sources: one per channel, in order.

    Attributes:
        space: the manifold of the readings.
        known: if every reading is a component of the state (see `components`), the indices of
            these components `(ny,)` and the Jacobian H `(m, n)`; else None.
        reach: the readings depend on the first `reach` tangent coordinates only.
        timed: whether a reading is a function of the user's, which is given the time.
        stage: the highest pipeline stage (mjtStage) that the sensors need.
    """

    def __init__(self, model: mujoco.MjModel, sources: Sequence[Measurand]):
        self.space = product([s.space for s in sources])
        sensors = [i for s in sources for i in s.sensors]
        parts = [s.columns(model) for s in sources]
        self._columns = np.concatenate(parts) if parts else np.zeros(0, np.intp)
        self._nothing = NoReturns.of(model, sensors, self._columns)
        self.stage = needed_stage(model, sensors)
        self._sources = tuple(sources) if any(s.function for s in sources) else ()
        self.known = None if self._sources else components(model, sensors, self._columns)
        nv, na = model.nv, model.na
        reach = (0, nv, 2 * nv, 2 * nv + na)  # by stage: a position does not depend on velocities
        self.reach = reach[-1] if self._sources else reach[self.stage]
        self.timed = bool(self._sources)

    def read(
        self,
        backend: Backend,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float | Array,
        force: Float[Array, "... nv"] | None = None,
    ) -> Float[Array, "*lead ny"]:
        """Noise-free readings at states x, those of the channels concatenated in order.

        The sensors see the generalized forces `force` too; None for none.
        """
        if self.known is not None:
            return x.take(self.known[0], axis=-1)  # in the order of C, so that sums round alike
        if not self._sources:
            return self._sensed(backend, x, u, t, force)
        sensed, start = np.empty((*x.shape[:-1], 0)), 0
        if len(self._columns):
            sensed = self._sensed(backend, x, u, t, force)
        parts = []
        for source in self._sources:
            if source.function is not None:
                assert isinstance(t, float)  # one time for all: see `timed`
                parts.append(source.call(x, u[..., : backend.model.nu], t))
                continue
            parts.append(sensed[..., start : start + source.space.nx])
            start += source.space.nx
        return np.concatenate(parts, axis=-1)

    def _sensed(
        self, backend: Backend, x: Array, u: Array, t: float | Array, force: Array | None
    ) -> Array:
        """The readings of the MuJoCo sensors, +inf where they have no return."""
        if self._nothing is None:
            return backend.read(x, u, t, self.stage, self._columns, force)
        width, columns = len(self._columns), (self._columns, self._nothing.columns)
        raw = backend.read(x, u, t, self.stage, np.concatenate(columns), force)
        y = raw[..., :width]
        self._nothing.mark(y, raw[..., width:])
        return y


def sensor_columns(model: mujoco.MjModel, sensors: Sequence[int]) -> Int[NDArray[np.intp], " m"]:
    """Columns of `sensordata` that hold the readings of the sensors, in order."""
    parts = [np.arange(model.sensor_dim[i]) + model.sensor_adr[i] for i in sensors]
    return np.concatenate(parts).astype(np.intp) if parts else np.zeros(0, np.intp)


def needed_stage(model: mujoco.MjModel, sensors: Sequence[int]) -> int:
    """The highest pipeline stage (mjtStage) that the sensors need."""
    return max((_stage(model, i) for i in sensors), default=0)


def _stage(model: mujoco.MjModel, sensor: int) -> int:
    stage = int(model.sensor_needstage[sensor])
    if model.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_E_KINETIC:
        # MuJoCo declares the position stage, but the velocities are then those of another row.
        stage = max(stage, int(mujoco.mjtStage.mjSTAGE_VEL))
    return stage
