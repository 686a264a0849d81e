"""What a filter has received so far, filed under the instant at which it is to be fused.

Readings of several channels for one instant update jointly, whenever they came; a reading is fused
once. Of several readings of a channel for one instant a run keeps the first in the first layer of
measurements, the second in the second: as few updates as there are readings.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estbench.sensors.sampling import Delivery
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class JointMeasurement:
    """One joint measurement: channels in their order; without a mask everything has arrived."""

    channels: tuple[str, ...]
    y: Float[Array, "run ny"]
    mask: Bool[Mask, "run m"] | None


Layer = dict[str, tuple[Float[Array, "run ny"], Bool[Mask, " run"] | None]]
"""Channel -> its readings, and the runs in which one has arrived; None for all."""


class Inbox:
    """Deliveries filed by instant.

    Attributes:
        spaces: channel -> the manifold of its readings, in the order of the measurement vector.
    """

    def __init__(self, spaces: Mapping[str, Manifold]):
        self.spaces = dict(spaces)
        self._filed: dict[int, list[Layer]] = {}
        self._joints: dict[int, list[JointMeasurement]] = {}
        self._orders: dict[tuple[str, ...], tuple[str, ...]] = {}

    def add(self, instant: int, delivery: Delivery) -> None:
        """File a delivery under the instant at which it is to be fused."""
        self._joints.pop(instant, None)
        layers = self._filed.setdefault(instant, [])
        channel, y = delivery.channel, delivery.y
        came = delivery.mask
        for layer in layers:
            if channel not in layer:
                layer[channel] = y, came
                return
            first, had = layer[channel]
            if had is None:
                continue
            came = np.ones(len(y), bool) if came is None else came
            layer[channel] = np.where(had[:, None], first, y), had | came
            came = came & had
            if not came.any():
                return
        layers.append({channel: (y, came)})

    def at(self, instant: int) -> list[JointMeasurement]:
        """The joint measurements of an instant, layer after layer."""
        if instant not in self._filed:
            return []
        if instant not in self._joints:
            self._joints[instant] = [self._join(layer) for layer in self._filed[instant]]
        return self._joints[instant]

    def forget(self, instant: int) -> None:
        """Drop what is filed before an instant that no reading can reach any more."""
        for old in [i for i in self._filed if i < instant]:
            del self._filed[old]
            self._joints.pop(old, None)

    def _join(self, layer: Layer) -> JointMeasurement:
        named = tuple(layer)
        if named not in self._orders:
            self._orders[named] = tuple(name for name in self.spaces if name in layer)
        channels = self._orders[named]
        parts = [layer[name] for name in channels]
        y = np.concatenate([part for part, _ in parts], axis=1) if len(parts) > 1 else parts[0][0]
        if all(came is None or came.all() for _, came in parts):
            return JointMeasurement(channels, y, None)
        columns = [
            np.broadcast_to(True if came is None else came[:, None], (len(y), self.spaces[name].n))
            for name, (_, came) in zip(channels, parts)
        ]
        return JointMeasurement(channels, y, np.concatenate(columns, axis=1))
