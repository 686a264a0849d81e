"""Readings of one channel on their way: sent when taken, received when their latency is over."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estbench.envs.keys import Keys, Mask, RowNoise
from estbench.sensors.channel import Channel
from estbench.shapes import Array


@dataclass(eq=False)
class _Packet:
    """Readings `(row, ny)` taken at one time, the rows they are of, and when each arrives."""

    y: Array
    rows: Mask
    arrives: NDArray[np.int64]
    age: int = 0


class Delay:
    """The latency of a channel, fixed or random, in each row by its own clock.

    Args:
        channel: the sensor.
        rows: how many robots.
    """

    def __init__(self, channel: Channel, rows: int):
        self._timing, self._rows = channel.timing, rows
        self._noise = RowNoise(rows, {f"sensor:{channel.name}:latency": 1})
        self._packets: list[_Packet] = []

    def start(self, mask: Mask, keys: Keys) -> None:
        """Begin episodes in the rows of a mask: what was on its way to them is lost."""
        self._noise.start(mask, keys)
        for packet in self._packets:
            packet.rows = packet.rows & ~mask

    def send(self, y: Array, here: Mask | None, due: Mask | None, tick: NDArray[np.int64]) -> None:
        """Readings `(row, ny)` of the rows `here` set out at each row's `tick`.

        Args:
            y: readings.
            here: rows whose reading is not lost; None is all.
            due: rows that take a reading, of which each draws a latency; None is all.
            tick: physics steps since the reset `(row,)`.
        """
        late = np.full(self._rows, self._timing.latency)
        if self._timing.latency_std:
            white = self._noise.draw(due)[:, 0]
            late = np.maximum(late + self._timing.latency_std * white, 0.0)
        rows = np.ones(self._rows, bool) if here is None else here
        self._packets.append(_Packet(y, rows, tick + np.ceil(late - 1e-6).astype(np.int64)))

    def receive(self, tick: NDArray[np.int64]) -> list[tuple[Array, Mask | None, int]]:
        """What has arrived: readings, their rows (None: all), and calls since they set out."""
        out = []
        for packet in self._packets:
            there = packet.rows & (packet.arrives <= tick)
            if there.any():
                out.append((packet.y, None if there.all() else there, packet.age))
                packet.rows = packet.rows & ~there
            packet.age += 1
        self._packets = [packet for packet in self._packets if packet.rows.any()]
        return out
