"""The verdict on an estimator: what is refuted, what is shown, and how many runs would decide.

Consistent is said only of what is shown: no hypothesis of the family is refuted, and the intervals
lie within the tolerance (equivalence). What the runs can neither refute nor show is undecided.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from estbench.consistency.fields import Record
from estbench.consistency.hypotheses import (
    BIASES,
    VARIABLES,
    Hypothesis,
    Kind,
    family,
)
from estbench.consistency.intervals import normal_quantile
from estbench.estimators.beliefs import Fault
from estbench.shapes import Int, Ints

MOST_LOST = 0.05
"""A larger share of diverged runs is `diverging`, whatever the other runs are; a larger share of
runs whose truth could not be simulated is `simulation failed`."""
FEW_LOST = 0.01
"""With a larger share no filter is consistent."""
PART = 2.0
"""A part (a coordinate, a block of time, a phase) must be shown to be within this factor of its
variance."""
RARE = 0.5
"""A phase that a smaller share of the runs has need not be shown."""
MANY = 1_000_000
"""More runs are not recommended."""


class Verdict(StrEnum):
    """The verdict, in a word."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    BIASED = "biased"
    CONSERVATIVE = "conservative"
    CORRELATED = "correlated"
    DIVERGING = "diverging"
    SIMULATION_FAILED = "simulation failed"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Judgement:
    """The verdict on one estimator and what it is made from.

    Attributes:
        verdict: the word.
        hypotheses: of the family, with their tests.
        refuted: those that are refuted by more than the tolerance.
        open: those that are neither refuted nor shown to be within the tolerance.
        needed: runs that would decide the open ones if the estimates stayed as they are; None where
            nothing is open or no number can be given.
        runs: that are tested: diverged ones and copies of other runs are left out.
        lost: how many runs diverged while their truth went on.
        failed: how many runs ended because the simulation of the truth failed; they say nothing
            about the estimator.
        failed_step: the first instant at which it failed, -1 for none.
        copies: how many runs are equal to another one in every number.
        lacking: kinds that could not be tested, since the store is of an earlier version.
    """

    verdict: Verdict
    hypotheses: tuple[Hypothesis, ...] = field(repr=False)
    refuted: tuple[Hypothesis, ...]
    open: tuple[Hypothesis, ...]
    needed: int | None
    runs: int
    lost: int
    failed: int
    failed_step: int
    copies: int
    lacking: tuple[Kind, ...]


def judge(record: Record, level: float = 0.95, tolerance: float = 0.1) -> Judgement:
    """The verdict from the numbers of each run.

    A hypothesis is *refuted* if Holm's p-value over the family is at most 1 - level and the
    estimate is off by more than the tolerance; *shown* if its interval is within the tolerance.
    Consistent: none is refuted, and `NEES`, `NIS` and their parts are shown. With tolerance 0
    nothing can be shown: the pure test, by which a consistent filter is refused with probability
    1 - level at most.

    Args:
        record: as `records.merge` gives it.
        level: confidence.
        tolerance: a difference of NEES/n or NIS/m from 1 that does not matter; a bias of
            √tolerance σ adds as much to NEES/n.
    """
    diverged = record["diverged"].astype(bool)
    chosen = distinct(record, np.flatnonzero(~diverged))
    copies = int((~diverged).sum()) - len(chosen)
    tested = np.zeros(len(diverged), bool)
    tested[chosen] = True
    hypotheses = family(record, tested, level)
    refuted = tuple(h for h in hypotheses if is_refuted(h, level, tolerance))
    unshown = tuple(
        h
        for h in hypotheses
        if h not in refuted
        and not is_shown(h, tolerance)
        and not (h.kind is Kind.NEES_PHASE and h.runs < RARE * len(chosen))
    )
    failed = diverged & (record["fault"] == Fault.TRUTH)
    judged, lost = int((~failed).sum()), int((diverged & ~failed).sum())
    if failed.sum() > MOST_LOST * len(failed):
        verdict = Verdict.SIMULATION_FAILED
    else:
        verdict = word(refuted, unshown, len(chosen), lost / max(judged, 1))
    return Judgement(
        verdict=verdict,
        hypotheses=hypotheses,
        refuted=refuted,
        open=unshown,
        needed=_needed(unshown, level, tolerance, len(chosen))
        if verdict is Verdict.UNDECIDED
        else None,
        runs=len(chosen),
        lost=lost,
        failed=int(failed.sum()),
        failed_step=int(record["fault_step"][failed].min()) if failed.any() else -1,
        copies=copies,
        lacking=tuple(
            kind
            for kind, names in VARIABLES.items()
            if kind is not Kind.INNOVATION and not set(names) <= record.keys()
        ),
    )


def distinct(record: Record, runs: Int[Ints, " k"]) -> Int[Ints, " _"]:
    """The runs without those whose NEES/n and RMSE equal those of an earlier one to seven digits.

    A run that was counted twice, or has no random numbers, says nothing new.
    """
    numbers = np.column_stack([record["anees"][runs], record["mse"][runs]])
    with np.errstate(over="ignore"):
        numbers = numbers.astype(np.float32)
    numbers = np.ascontiguousarray(numbers + 0.0)  # no negative zero
    rows = numbers.view(np.dtype((np.void, numbers.dtype.itemsize * numbers.shape[1])))[:, 0]
    _, first = np.unique(rows, return_index=True)
    return runs[np.sort(first)]


def is_refuted(h: Hypothesis, level: float, tolerance: float) -> bool:
    """Whether the difference from the ideal value is significant, and larger than the tolerance."""
    most = np.sqrt(tolerance) if h.kind in BIASES else tolerance
    return bool(h.adjusted <= 1 - level and abs(h.mean.value - h.ideal) > most)


def bounds(h: Hypothesis, tolerance: float) -> tuple[float, float] | None:
    """Where the interval of a hypothesis must be to be shown; None if that is not asked.

    Of NEES/n and NIS/m within 1 ± tolerance. Of their parts within a factor `PART` of the variance:
    a mean error of σ doubles the mean square.
    """
    if h.kind in (Kind.NEES, Kind.NIS):
        return 1 - tolerance, 1 + tolerance
    if h.kind in (Kind.NEES_BLOCK, Kind.NEES_PHASE, Kind.COORDINATE):
        return 1 / PART, PART
    if h.kind is Kind.BIAS:
        return -float(np.sqrt(PART - 1)), float(np.sqrt(PART - 1))
    return None


def is_shown(h: Hypothesis, tolerance: float) -> bool:
    """Whether the interval is where it must be."""
    wanted = bounds(h, tolerance)
    return wanted is None or (wanted[0] <= h.mean.low and h.mean.high <= wanted[1])


SIZES = (
    Kind.NEES, Kind.NEES_BLOCK, Kind.NEES_SIZE, Kind.NEES_RUNS, Kind.COORDINATE,
    Kind.COORDINATE_BLOCK, Kind.COORDINATE_SIZE, Kind.NEES_ALONG, Kind.NEES_PHASE,
)  # fmt: skip
"""The kinds that compare the size of the errors with the covariance."""
INNOVATIONS = (Kind.NIS, Kind.NIS_BLOCK, Kind.CHANNEL)


def above(h: Hypothesis) -> bool:
    """Whether the estimate is above the ideal value."""
    return h.mean.value > h.ideal


def sizes(refuted: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those that say that the size of the errors is wrong.

    A bias enlarges NEES along its own direction, which is then not counted.
    """
    biased = any(h.kind in BIASES for h in refuted)
    return [h for h in refuted if h.kind in SIZES and not (biased and h.kind is Kind.NEES_ALONG)]


def word(
    refuted: Sequence[Hypothesis], unshown: Sequence[Hypothesis], runs: int, lost: float
) -> Verdict:
    """What is dangerous comes first: too small a covariance, then a bias, then too large a one."""
    if lost > MOST_LOST:
        return Verdict.DIVERGING
    wrong = sizes(refuted)
    tests: Mapping[Verdict, bool] = {
        Verdict.OVERCONFIDENT: any(map(above, wrong)),
        Verdict.BIASED: any(h.kind in BIASES for h in refuted),
        Verdict.CONSERVATIVE: bool(wrong),
    }
    for word, found in tests.items():
        if found:
            return word
    innovations = [h for h in refuted if h.kind in INNOVATIONS]
    if innovations:
        worst = max(innovations, key=lambda h: abs(np.log(max(h.mean.value, 1e-300))))
        return Verdict.OVERCONFIDENT if above(worst) else Verdict.CONSERVATIVE
    if refuted:
        return Verdict.CORRELATED
    if lost > FEW_LOST:
        return Verdict.DIVERGING
    return Verdict.UNDECIDED if unshown or runs < 2 else Verdict.CONSISTENT


def _needed(unshown: Sequence[Hypothesis], level: float, tolerance: float, runs: int) -> int | None:
    """Runs after which each open hypothesis would be shown or refuted, with the estimates as now.

    The half-width q s/√N of the interval must be at most the distance of the estimate from the
    nearer bound. Of a hypothesis that only a share of the runs has a value for, N is that share.
    """
    counts = []
    for h in unshown:
        low, high = bounds(h, tolerance) or (0.0, 0.0)
        distance = min(abs(h.mean.value - low), abs(h.mean.value - high))
        ratio = normal_quantile(level) * h.spread / max(distance, 1e-12)
        counts.append(max(h.runs + 1.0, ratio**2) * runs / h.runs)
    needed = max(counts, default=np.inf)
    return int(np.ceil(needed)) if needed <= MANY else None
