"""Readings on their way from a sensor to whoever fuses them."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.spaces.linalg import surely_finite


class Delivery(NamedTuple):
    """Readings of channels that are sampled together, taken at one tick, that arrive at one tick.

    Attributes:
        channels: their names, in the measurement's order.
        due: tick at which they were due; `(row,)` where the rows differ.
        y: of one channel after the other `(row, ny)`; only the rows of `mask` mean anything. A
            component that is +inf had no return (see `robots.no_return`): it has not arrived.
        mask: rows whose reading arrives now, at least one component of it `(row,)`; None means all.
        taken: tick at which they were taken; without jitter `due`.
        widths: numbers in the reading of each channel; empty where there is one channel.
    """

    channels: tuple[str, ...]
    due: int | Int[Ints, " row"]
    y: Float[Array, "row ny"]
    mask: Bool[Mask, " row"] | None
    taken: int
    widths: tuple[int, ...] = ()

    def divided(self) -> Iterator["Delivery"]:
        """One delivery for each channel."""
        if len(self.channels) == 1:
            yield self
            return
        start = 0
        for name, width in zip(self.channels, self.widths):
            stop = start + width
            y, mask = self.y[:, start:stop], self.mask
            if not surely_finite(y):
                seen = np.any(~np.isinf(y), axis=1)
                mask = np.asarray(seen if mask is None else mask & seen)
            yield self._replace(channels=(name,), y=y, mask=mask, widths=())
            start = stop


def divided(deliveries: Iterable[Delivery]) -> list[Delivery]:
    """The same deliveries, one for each channel."""
    return [part for delivery in deliveries for part in delivery.divided()]
