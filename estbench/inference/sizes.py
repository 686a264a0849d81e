"""How large the coordinates of some rows have been: their rounding errors are relative to that."""

import numpy as np

from estbench.shapes import Array, Float, Int, Ints
from estbench.spaces.manifold import Manifold

_LATER = 64
"""Points that wait to be compared; in most steps only `bound` is needed."""


class Sizes:
    """The largest size of each coordinate since its row began, of points that nobody overwrites.

    Args:
        space: of the points.
        rows: how many.

    Attributes:
        bound: of the squared size of every coordinate of every row.
    """

    def __init__(self, space: Manifold, rows: int):
        self._space, self.bound = space, 0.0
        self._largest, self._waiting = np.zeros((rows, space.n)), list[Array]()

    def add(self, x: Float[Array, "row nx"]) -> None:
        """The rows are at x; a coordinate that is not finite does not count."""
        square = float(np.vdot(x, x))
        # Not a number: some coordinate is not finite, and the others are not bounded by it.
        self.bound = max(self.bound, square) if square == square else np.inf
        self._waiting.append(x)
        if len(self._waiting) >= _LATER:
            self._compare()

    def forget(self, rows: Int[Ints, " k"]) -> None:
        """Some rows begin anew."""
        self._compare()
        self._largest[rows] = 0.0
        self.bound = float(np.vdot(self._largest, self._largest))

    @property
    def largest(self) -> Float[Array, "row n"]:
        """The largest |x| of each coordinate of the tangent; 1 for those of a rotation."""
        self._compare()
        return self._largest

    def _compare(self) -> None:
        for x in self._waiting:
            self._largest = np.fmax(self._largest, self._space.magnitude(x))
        self._waiting.clear()
