"""The size of the errors in each block of time, and the blocks that the verdict refutes."""

from dataclasses import dataclass

import numpy as np

from estbench.analysis.evidence import Evidence
from estbench.consistency.hypotheses import Hypothesis, Kind
from estbench.consistency.intervals import Interval
from estbench.consistency.verdict import above
from estbench.shapes import Array, Bool, Float, Mask


@dataclass(frozen=True, eq=False)
class Course:
    """A ratio whose ideal value is 1, in each block of time.

    Attributes:
        what: NEES/n, or the coordinate and its squared error over its variance.
        values: of each run.
        high: the blocks in which the verdict refutes it, the ratio being above 1.
        low: those in which it is below 1.
    """

    what: str
    values: Float[Array, "run block"]
    high: Bool[Mask, " block"]
    low: Bool[Mask, " block"]

    def block(self, e: Evidence, i: int) -> Interval:
        """The mean over runs in one block."""
        return e.ratio(self.values[:, i])[0]

    def others(self, e: Evidence, blocks: Bool[Mask, " block"]) -> Interval:
        """The mean over runs in all other blocks together."""
        rest = self.values[:, ~blocks]
        known = np.isfinite(rest)
        count = known.sum(axis=1)
        total = np.where(known, rest, 0.0).sum(axis=1)
        return e.ratio(np.where(count > 0, total / np.maximum(count, 1), np.nan))[0]


def course(e: Evidence) -> Course | None:
    """NEES/n if the verdict refutes it in any block; else the coordinate that fails most.

    None if the verdict refutes no block.
    """
    if failing := e.refuted(Kind.NEES_BLOCK):
        return _course("NEES/n", e.record["nees_by_block"], failing)
    if failing := e.refuted(Kind.COORDINATE_BLOCK):
        worst = max(failing, key=lambda h: abs(np.log(max(h.mean.value, 1e-300)))).coordinate
        assert worst is not None
        return _course(
            f"the squared error of {e.names[worst]} over its variance",
            e.record["scaled_square"][..., worst],
            [h for h in failing if h.coordinate == worst],
        )
    return None


def _course(what: str, values: Float[Array, "run block"], failing: list[Hypothesis]) -> Course:
    high, low = np.zeros((2, values.shape[1]), bool)
    for h in failing:
        (high if above(h) else low)[h.block or 0] = True
    return Course(what, values, high, low)
