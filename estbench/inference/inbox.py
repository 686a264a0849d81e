"""What a filter has received so far, filed under the instant at which it is to be fused.

Readings of several channels for one instant update jointly, whenever they came; a reading is fused
once. Of several readings of a channel for one instant a run keeps the first in the first layer of
measurements, the second in the second: as few updates as there are readings.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from estbench.sensors.delivery import Delivery, divided
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import surely_finite
from estbench.spaces.manifold import Manifold, product


class JointMeasurement(NamedTuple):
    """One joint measurement: channels in their order; without a mask everything has arrived.

    A component without a return is masked, and 0 in y.
    """

    channels: tuple[str, ...]
    y: Float[Array, "run ny"]
    mask: Bool[Mask, "run m"] | None


@dataclass(frozen=True, eq=False)
class Layer:
    """At most one reading of each channel in each run.

    Attributes:
        y: channel -> readings.
        came: channel -> the runs in which one has arrived; a channel that is not here has arrived
            in all.
    """

    y: dict[str, Float[Array, "run ny"]] = field(default_factory=dict)
    came: dict[str, Bool[Mask, " run"]] = field(default_factory=dict)

    def put(self, channel: str, y: Array, came: Mask | None) -> None:
        """Set the readings of a channel."""
        self.y[channel] = y
        if came is not None:
            self.came[channel] = came
        else:
            self.came.pop(channel, None)


class Inbox:
    """Deliveries filed by instant.

    Attributes:
        spaces: channel -> the manifold of its readings, in the order of the measurement vector.
    """

    def __init__(self, spaces: Mapping[str, Manifold]):
        self.spaces = dict(spaces)
        # Until a second delivery comes to an instant, the first is a joint measurement as it is.
        self._single: dict[int, Delivery] = {}
        self._filed: dict[int, list[Layer]] = {}
        self._joints: dict[int, list[JointMeasurement]] = {}
        self._orders: dict[tuple[str, ...], tuple[str, ...]] = {}

    def add(self, instant: int, delivery: Delivery) -> None:
        """File a delivery under the instant at which it is to be fused."""
        if instant not in self._filed and instant not in self._single:
            self._single[instant] = delivery
            return
        self._joints.pop(instant, None)
        before = self._single.pop(instant, None)
        for part in divided((delivery,) if before is None else (before, delivery)):
            self._file(instant, part)

    def _file(self, instant: int, delivery: Delivery) -> None:
        """File a delivery of one channel."""
        layers = self._filed.setdefault(instant, [])
        (channel,), y, came = delivery.channels, delivery.y, delivery.mask
        for layer in layers:
            if channel not in layer.y:
                layer.put(channel, y, came)
                return
            had = layer.came.get(channel)
            if had is None:
                continue
            came = np.ones(len(y), bool) if came is None else came
            layer.put(channel, np.where(had[:, None], layer.y[channel], y), had | came)
            came = came & had
            if not came.any():
                return
        layers.append(Layer())
        layers[-1].put(channel, y, came)

    def at(self, instant: int) -> list[JointMeasurement]:
        """The joint measurements of an instant, layer after layer."""
        if instant not in self._joints:
            if instant in self._single:
                self._joints[instant] = [self._alone(self._single[instant])]
            elif instant in self._filed:
                self._joints[instant] = [self._join(layer) for layer in self._filed[instant]]
            else:
                return []
        return self._joints[instant]

    def clear(self) -> None:
        """Drop everything."""
        self._single.clear()
        self._filed.clear()
        self._joints.clear()

    def forget(self, instant: int) -> None:
        """Drop what is filed before an instant that no reading can reach any more."""
        for filed in (self._single, self._filed, self._joints):
            for old in [i for i in filed if i < instant]:
                del filed[old]

    def _alone(self, delivery: Delivery) -> JointMeasurement:
        """A delivery as a joint measurement."""
        mask, y, channels = delivery.mask, delivery.y, delivery.channels
        finite = surely_finite(y)
        if finite and (mask is None or mask.all()):
            return JointMeasurement(channels, y, None)
        m = sum(self.spaces[name].n for name in channels)
        whole = np.ones((len(y), m), bool) if mask is None else mask[:, None].repeat(m, axis=1)
        return JointMeasurement(channels, y, whole) if finite else self._some(channels, y, whole)

    def _join(self, layer: Layer) -> JointMeasurement:
        named = tuple(layer.y)
        if named not in self._orders:
            self._orders[named] = tuple(name for name in self.spaces if name in layer.y)
        channels = self._orders[named]
        parts = [*map(layer.y.__getitem__, channels)]
        y = np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]
        finite = surely_finite(y)
        if finite and (not layer.came or all(came.all() for came in layer.came.values())):
            return JointMeasurement(channels, y, None)
        columns = [
            np.broadcast_to(
                layer.came[name][:, None] if name in layer.came else True,
                (len(y), self.spaces[name].n),
            )
            for name in channels
        ]
        mask = np.concatenate(columns, axis=1)
        return JointMeasurement(channels, y, mask) if finite else self._some(channels, y, mask)

    def _some(self, channels: tuple[str, ...], y: Array, mask: Mask) -> JointMeasurement:
        """A joint measurement of which components without a return, +inf, are masked."""
        gone = product([self.spaces[name] for name in channels]).infinite(y)
        if not gone.any():  # NaN of a run whose truth has failed
            return JointMeasurement(channels, y, None if mask.all() else mask)
        return JointMeasurement(channels, np.where(np.isinf(y), 0.0, y), mask & ~gone)
