"""Where a MuJoCo sensor says that it has no reading: no return.

A ray that hits nothing has the distance -1, two geoms that are further apart than the cutoff have
the distance of the cutoff, a contact sensor without contact is zero, and so on (MuJoCo's XML
reference, section sensor). Such a value is no measurement. estbench writes +inf in its place, as
ROS does for a range finder without a return (REP 117), and a component that is +inf has not
arrived.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.robots import library
from estbench.shapes import Array, Bool, Float, Int, Mask

_TYPES = mujoco.mjtSensor
_USER = _TYPES.mjSENS_USER
# Zero without a collision within the cutoff, or without an active limit.
_ZERO = (
    _TYPES.mjSENS_GEOMNORMAL, _TYPES.mjSENS_GEOMFROMTO,
    _TYPES.mjSENS_JOINTLIMITPOS, _TYPES.mjSENS_JOINTLIMITVEL,
    _TYPES.mjSENS_TENDONLIMITPOS, _TYPES.mjSENS_TENDONLIMITVEL,
)  # fmt: skip
# Of each field of a ray, in their order, its width and its value without a return: the distance,
# the direction, the origin (which has none), the point, the normal, the depth.
_RAY_FIELDS = (1, -1.0), (3, 0.0), (3, np.nan), (3, 0.0), (3, 0.0), (1, -1.0)


@dataclass(frozen=True, eq=False)
class NoReturns:
    """The sensors of some readings that may have no return.

    Attributes:
        columns: columns of `sensordata` that are compared, slot after slot. A slot is one ray, one
            contact or one sensor: its components have a return together.
        nothing: value of each of these columns without a return; a slot has no return where all
            its columns have these values.
        starts: where each slot begins in `columns`.
        components: components of the reading that may have no return.
        slots: the slot of each of these.
    """

    columns: Int[NDArray[np.intp], " compared"]
    nothing: Float[Array, " compared"]
    starts: Int[NDArray[np.intp], " slot"]
    components: Int[NDArray[np.intp], " k"]
    slots: Int[NDArray[np.intp], " k"]

    @classmethod
    def of(
        cls,
        model: mujoco.MjModel,
        sensors: Sequence[int],
        read: Int[NDArray[np.intp], " m"],
    ) -> "NoReturns | None":
        """Of a reading; None where every sensor always has one.

        Args:
            model: compiled MuJoCo model.
            sensors: its sensors that are read.
            read: columns of `sensordata` of the reading's components.
        """
        slots = [slot for i in sensors for slot in _slots(model, i)]
        if not slots:
            return None
        columns = np.concatenate([columns for columns, _ in slots])
        nothing = np.concatenate([values for _, values in slots])
        widths = [len(values) for _, values in slots]
        owner = np.full(model.nsensordata, -1, np.intp)
        owner[columns] = np.repeat(np.arange(len(slots)), widths)
        components = np.flatnonzero(owner[read] >= 0)
        starts = np.cumsum([0, *widths[:-1]]).astype(np.intp)
        return cls(columns, nothing, starts, components, owner[read][components])

    def mark(self, y: Float[Array, "... m"], compared: Float[Array, "... compared"]) -> None:
        """Write +inf into the components of y without a return.

        Args:
            y: the readings, changed in place.
            compared: `sensordata` at `columns`.
        """
        gone: Bool[Mask, "... slot"] = np.logical_and.reduceat(
            compared == self.nothing, self.starts, axis=-1
        )
        if gone.any():
            part = y[..., self.components]
            y[..., self.components] = np.where(gone[..., self.slots], np.inf, part)


def may_miss(model: mujoco.MjModel, sensor: int) -> bool:
    """Whether a sensor may have no return."""
    return next(_slots(model, sensor), None) is not None


def never_returns(model: mujoco.MjModel, sensor: int) -> bool:
    """Whether a sensor has no return at any time: a `user` sensor that nothing computes."""
    return _TYPES(model.sensor_type[sensor]) == _USER and may_miss(model, sensor)


def _slots(model: mujoco.MjModel, sensor: int) -> Iterator[tuple[NDArray[np.intp], Array]]:
    """The columns of each slot of a sensor, and their values without a return."""
    kind, width = _TYPES(model.sensor_type[sensor]), int(model.sensor_dim[sensor])
    columns = model.sensor_adr[sensor] + np.arange(width, dtype=np.intp)
    cutoff = float(model.sensor_cutoff[sensor])
    if kind == _TYPES.mjSENS_RANGEFINDER:
        fields = [f for k, f in enumerate(_RAY_FIELDS) if model.sensor_intprm[sensor, 0] >> k & 1]
        values = np.concatenate([np.full(size, value) for size, value in fields])
        values = np.maximum(values, -cutoff) if cutoff > 0 else values  # MuJoCo clips -1 too
        compared = ~np.isnan(values)
        if compared.any():
            for ray in columns.reshape(-1, len(values)):
                yield ray[compared], values[compared]
    elif kind == _TYPES.mjSENS_CONTACT:
        for contact in columns.reshape(max(1, int(model.sensor_intprm[sensor, 2])), -1):
            yield contact, np.zeros(len(contact))
    elif kind == _TYPES.mjSENS_GEOMDIST:
        yield columns, np.full(width, cutoff)
    elif kind in _ZERO or (kind == _USER and not library.computes_user_sensors()):
        yield columns, np.zeros(width)
