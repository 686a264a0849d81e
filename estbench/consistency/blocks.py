"""Blocks: named intervals of time, in each of which the errors are compared with the covariance.

An average over the whole run hides a filter that is overconfident first and conservative later.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estbench.consistency.sums import Mean
from estbench.shapes import Array, Bool, Float, Mask

COUNT = 10
"""How many blocks a run is divided into."""


@dataclass(frozen=True)
class Block:
    """An interval of time.

    Attributes:
        start: s, the interval does not contain it.
        end: s, the interval contains it.
        name: of a phase of the scenario; empty for a part of the run that is as long as the others.
    """

    start: float
    end: float
    name: str = ""

    def members(self, times: Float[Array, " time"]) -> Bool[Mask, " time"]:
        """The instants in it. The start of the run, t = 0, is in no block."""
        slack = 1e-9 * (self.end - self.start)  # sums of steps round differently
        return (times > self.start + slack) & (times <= self.end + slack) & (times > 0)


def blocks(times: Float[Array, " time"], burn_in: float = 0.0) -> tuple[Block, ...]:
    """`COUNT` blocks of equal length from the burn-in to the end of the run.

    Args:
        times: of the instants and the start, s.
        burn_in: s that are left out at the start.
    """
    edges = np.linspace(min(burn_in, times[-1]), times[-1], COUNT + 1).tolist()
    return tuple(Block(start, end) for start, end in pairwise(edges))


def span(chosen: Sequence[Block]) -> str:
    """`from 0.0 to 0.4 s`, of blocks that follow each other; a phase by its name.

    The times have as many decimals as show them to 2% of the length.

    Args:
        chosen: in order.
    """
    if len(chosen) == 1 and chosen[0].name:
        return f"in {chosen[0].name}"
    start, end = chosen[0].start, chosen[-1].end
    slack, digits = 0.02 * (end - start), 1
    while max(abs(round(x, digits) - x) for x in (start, end)) > slack:
        digits += 1
    return f"from {start:.{digits}f} to {end:.{digits}f} s"


def means(
    values: Float[Array, "time run *any"],
    counted: Bool[Mask, "..."],
    members: Sequence[Bool[Mask, " time"]],
) -> Mean:
    """Mean of some values over the instants of each block `(run, block, ...)`.

    NaN for a block without any.

    Args:
        values: of each instant.
        counted: the values that count.
        members: the instants of each block.
    """
    shape = values.shape[1], len(members), *values.shape[2:]
    total, number = np.zeros(shape), np.zeros(shape, np.int64)
    for i, inside in enumerate(members):
        if inside.any():
            part = np.broadcast_to(counted[inside], values[inside].shape)
            number[:, i] = part.sum(axis=0)
            total[:, i] = np.where(part, values[inside], 0.0).sum(axis=0)
    return Mean(total, number)
