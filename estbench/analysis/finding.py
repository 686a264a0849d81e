"""What a rule of `estbench explain` answers, and what it takes for a difference that matters."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estbench.analysis.evidence import Evidence
from estbench.consistency.intervals import Interval

MARGIN = 0.1
"""A relative difference from 1 of NEES/n or NIS/m that is too small to explain."""
LAG = 0.01
"""A lag-one correlation that is too small to explain."""


@dataclass(frozen=True)
class Finding:
    """One cause that the evidence shows.

    Attributes:
        rule: its name.
        text: the cause, and the evidence for it.
        remedy: what usually helps.
    """

    rule: str
    text: str
    remedy: str


Rule = Callable[[Evidence], Finding | None]


def above(i: Interval) -> bool:
    """Whether the whole interval is above 1 by more than the margin."""
    return bool(i.low > 1 + MARGIN)


def below(i: Interval) -> bool:
    """Whether the whole interval is below 1 by more than the margin."""
    return bool(i.high < 1 - MARGIN)


def sign(i: Interval) -> int:
    """1 or -1 where a correlation is above or below 0 and matters, else 0."""
    return int(np.sign(i.value)) if abs(i.value) > LAG and 0 not in i else 0
