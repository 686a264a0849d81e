"""Directions of a space in words: `root.x`, `root.rz - gyro.bias.z`."""

from collections.abc import Sequence

import numpy as np

from estbench.shapes import Array, Float

SMALL = 0.25
"""Components below this, relative to the largest, are not named."""
MOST = 5
"""Components that are named."""


def echelon(basis: Float[Array, "n r"]) -> Float[Array, "n r"]:
    """Another basis of the same subspace, of which each vector has a coordinate of its own.

    Gauss-Jordan elimination with complete pivoting: the columns have few components. Each has the
    length 1, and its largest component is positive.
    """
    rows = basis.T.copy()
    done: list[int] = []
    for _ in range(len(rows)):
        rest = np.abs(rows)
        rest[done] = 0.0
        i, j = np.unravel_index(int(rest.argmax()), rest.shape)
        rows[i] /= rows[i, j]
        for other in range(len(rows)):
            if other != i:
                rows[other] -= rows[other, j] * rows[i]
        done.append(int(i))
    order = np.argsort([int(np.argmax(np.abs(row))) for row in rows], kind="stable")
    rows = rows[order]
    largest = rows[np.arange(len(rows)), np.abs(rows).argmax(axis=1)]
    size = np.linalg.norm(rows, axis=1)
    return (rows * (np.sign(largest) / size)[:, None]).T


def said(direction: Float[Array, " n"], names: Sequence[str]) -> str:
    """A direction, in units of the prior's standard deviations.

    Components of equal size have a sign only; others the factor relative to the largest.
    """
    size = np.abs(direction)
    places = [int(i) for i in np.argsort(-size, kind="stable") if size[i] > SMALL * size.max()]
    if len(places) > MOST:
        listed = ", ".join(names[i] for i in sorted(places[:MOST]))
        return f"{listed} and {len(places) - MOST} more together"
    first = places[0]
    parts = []
    for i in sorted(places):
        ratio = float(direction[i] / direction[first])
        factor = "" if abs(abs(ratio) - 1.0) < SMALL else f"{abs(ratio):.2g} "
        sign = ("- " if parts else "-") if ratio < 0 else ("+ " if parts else "")
        parts.append(f"{sign}{factor}{names[i]}")
    return " ".join(parts)
