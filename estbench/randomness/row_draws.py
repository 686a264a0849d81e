"""Random numbers of many rows, draw after draw; each row counts its own draws and may start anew.

The numbers of a row are those of its run's stream (`streams`), whatever the other rows do. They are
taken from the generators a block of draws at a time.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from estbench.randomness.streams import Seeds, streams
from estbench.shapes import Array, Ints, Mask

Kind = Literal["normal", "uniform"]
BLOCK = 32
"""Draws that are made at a time where nobody knows how many there will be."""


class RowDraws:
    """Numbers `(row, width)` of one purpose.

    Args:
        rows: how many.
        purpose: of the streams.
        width: numbers per draw.
        kind: standard normal, or uniform on [0, 1).
        block: draws that are made at a time; all of them where their count is known.
        shape: what becomes of a block `(block, width)` before it is handed out, draw by draw;
            it must not mix the draws. Default nothing.
    """

    def __init__(
        self,
        rows: int,
        purpose: str,
        width: int,
        kind: Kind = "normal",
        block: int = BLOCK,
        shape: Callable[[Array], Array] | None = None,
    ):
        self._purpose, self._width, self._kind, self._shape = purpose, width, kind, shape
        self._generators: list[np.random.Generator | None] = [None] * rows
        self._length = max(1, block)
        self._block = np.zeros((self._length, rows, width))
        self._every = np.arange(rows)
        self._count = np.zeros(rows, np.int64)
        self._together: int | None = 0

    def start(self, rows: Ints, seed: Seeds, runs: Sequence[int]) -> None:
        """Begin anew in some rows, each with the stream of its run.

        Args:
            rows: their numbers.
            seed: of all of them, or one for each.
            runs: the number of the run in each.
        """
        if not self._width:
            return
        if len(rows) == len(self._count):
            self._together = 0
        elif self._together is not None:
            self._count[:], self._together = self._together, None
        for row, generator in zip(rows.tolist(), streams(seed, runs, self._purpose)):
            self._generators[row], self._count[row] = generator, 0
            self._fill(row)

    def draw(self, mask: Mask | None = None) -> Array:
        """The next numbers `(row, width)`; the rows outside the mask are not moved on.

        Args:
            mask: `(row,)`; None is all.
        """
        if mask is None and self._together is not None:
            place = self._together % self._length
            if place == 0 and self._together:
                for row in range(len(self._every)):
                    self._fill(row)
            self._together += 1
            return self._block[place]
        if self._together is not None:
            self._count[:], self._together = self._together, None
        place = self._count % self._length
        empty = (place == 0) & (self._count > 0)
        if mask is not None:
            empty &= mask
        for row in np.flatnonzero(empty).tolist():
            self._fill(row)
        self._count += 1 if mask is None else mask
        return self._block[place, self._every]

    def _fill(self, row: int) -> None:
        generator = self._generators[row]
        if generator is None or not self._width:
            return
        size = self._length, self._width
        numbers = (
            generator.standard_normal(size) if self._kind == "normal" else generator.random(size)
        )
        self._block[:, row] = numbers if self._shape is None else self._shape(numbers)
