"""Fixed directions in the space of a whitened error, along which its square has the mean 1.

A covariance with the right variances and wrong correlations has the right NEES and the right error
in each coordinate: P with its correlations left out has tr(diag(P)⁻¹ P) = n. Along sums and
differences of the whitened coordinates it is wrong.
"""

import numpy as np

from estbench.shapes import Array, Float

COUNT = 4
"""Directions: the sum, the alternating sum, the first half against the second, and their product.
Coordinates are positions and then velocities, so that the last two set these against each other."""


def directions(n: int) -> Float[Array, "n direction"]:
    """Unit vectors of equal components up to the sign; NaN for one that equals an earlier one.

    Args:
        n: dimension.
    """
    i = np.arange(n)
    alternating, halves = np.where(i % 2, -1.0, 1.0), np.where(2 * i < n, 1.0, -1.0)
    found = np.stack([np.ones(n), alternating, halves, alternating * halves], axis=1)
    for k in range(1, COUNT):
        if (np.abs(found[:, k] @ found[:, :k]) == n).any():
            found[:, k] = np.nan
    return found / np.sqrt(n)
