"""Random numbers of many rows, draw after draw; each row counts its own draws and may start anew.

The numbers of a row are those of its run's stream (`streams`), whatever the other rows do. They are
taken from the generators a block of draws at a time.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np

from estbench.randomness.streams import Seeds, streams
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask

Kind = Literal["normal", "uniform"]
BLOCK = 32
"""Draws that are made at a time where nobody knows how many there will be."""


MOST = 1024
"""Draws that are made at a time at most: the memory of a long run does not grow with them."""


class RowDraws:
    """Numbers `(row, width)` of some purposes, side by side.

    Args:
        rows: how many.
        parts: purpose of the streams -> numbers per draw.
        kind: standard normal, or uniform on [0, 1).
        block: draws that are made at a time, at most `MOST`; all of them where their count is
            known.
        shape: what becomes of a block `(block, width)` before it is handed out, draw by draw;
            it must not mix the draws. Default nothing.
    """

    def __init__(
        self,
        rows: int,
        parts: Mapping[str, int],
        kind: Kind = "normal",
        block: int = BLOCK,
        shape: Callable[[Float[Array, "block k"]], Float[Array, "block k"]] | None = None,
    ):
        self._parts, self._width = dict(parts), sum(parts.values())
        self._kind, self._shape = kind, shape
        self._generators: list[list[np.random.Generator]] = [[] for _ in range(rows)]
        self._length = max(1, min(block, MOST))
        self._block = np.zeros((self._length, rows, self._width))
        self._every = np.arange(rows)
        self._count = np.zeros(rows, np.int64)
        self._together: int | None = 0

    def start(self, rows: Int[Ints, " k"], seed: Seeds, runs: Sequence[int]) -> None:
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
        generators = zip(*(streams(seed, runs, purpose) for purpose in self._parts))
        for row, own in zip(rows.tolist(), generators):
            self._generators[row], self._count[row] = list(own), 0
            self._fill(row)

    def draw(self, mask: Bool[Mask, " row"] | None = None) -> Float[Array, "row k"]:
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
        own = self._generators[row]
        if not own or not self._width:
            return
        normal, sizes = self._kind == "normal", [(self._length, w) for w in self._parts.values()]
        parts = [g.standard_normal(s) if normal else g.random(s) for g, s in zip(own, sizes)]
        numbers = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        self._block[:, row] = numbers if self._shape is None else self._shape(numbers)
