"""The range of each parameter in which the verdict stays consistent, confirmed at its ends."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estbench.consistency.verdict import Verdict
from estbench.errors import StudyError
from estbench.sensitivities.elasticity import size
from estbench.sensitivities.parameter import Changes, Parameter
from estbench.sensitivities.points import Outcome

WAY = (1.1, 1.3, 2.0, 4.0, 10.0)
"""Factors that are tried one after the other until the verdict is another; the last is the reach
of the search."""
NARROW = 1.03
"""Ratio of the last consistent factor and the first that is not, at the end of the search."""
BACK = 0.8
"""Part of log factor that is left of an end which other runs do not confirm."""
TRIES = 6
"""Ends that are tried with other runs."""

Evaluate = Callable[[Sequence[Changes]], Sequence[Outcome]]
"""Computes points."""


@dataclass(frozen=True)
class End:
    """One end of a range.

    Attributes:
        factor: of the value, with which the verdict is consistent.
        beyond: the next factor that was tried, with which it is not; None where the range ends with
            the reach of the search, or with the last value that is possible.
        verdict: beyond it; `impossible` where the scenario cannot be run there.
        reason: of that verdict.
        nees: NEES/n with other runs, at the end.
        nees_beyond: the same beyond it.
        confirmed: whether the verdict of other runs at the end is consistent.
    """

    factor: float = 1.0
    beyond: float | None = None
    verdict: str = ""
    reason: str = ""
    nees: float = np.nan
    nees_beyond: float = np.nan
    confirmed: bool = False


@dataclass
class _Side:
    """The search to one side of a parameter: last consistent factor, first that is not."""

    parameter: Parameter
    up: bool
    inner: float = 1.0
    outer: float | None = None
    verdict: str = ""
    reason: str = ""
    way: list[float] = field(default_factory=lambda: list(WAY))

    def next(self) -> float | None:
        """The factor to try; None when the search is at its end."""
        if self.outer is None:
            while self.way:
                step = self.way.pop(0)
                factor = self.parameter.possible(step if self.up else 1 / step)
                if factor != self.inner and (factor > self.inner) == self.up:
                    return factor
            return None
        if max(self.outer / self.inner, self.inner / self.outer) <= NARROW:
            return None
        middle = self.parameter.possible(float(np.sqrt(self.inner * self.outer)))
        return None if middle in (self.inner, self.outer) else middle

    def note(self, factor: float, outcome: Outcome) -> None:
        """The verdict at a factor."""
        verdict, reason = _word(outcome)
        if verdict == Verdict.CONSISTENT:
            self.inner = factor
        else:
            self.outer, self.verdict, self.reason = factor, verdict, reason


def check(own: Outcome) -> None:
    """Whether there is a range at all.

    Args:
        own: of the scenario as it is.

    Raises:
        StudyError: the verdict is not consistent.
    """
    verdict, _ = _word(own)
    if verdict != Verdict.CONSISTENT:
        hint = "raise --runs" if verdict == Verdict.UNDECIDED else "see `estbench explain`"
        raise StudyError(
            f"the verdict is {verdict} as the scenario is, so that there is no range in which it "
            f"stays consistent; {hint}"
        )


def ranges(
    parameters: Sequence[Parameter], evaluate: Evaluate, others: Evaluate
) -> tuple[tuple[End, End], ...]:
    """The lower and the upper end of each parameter's range.

    Each side is searched by bisection on a log scale, on common random numbers. Then other runs
    are asked at the end that was found. Where they refuse it the end moves towards the value.

    Args:
        parameters: searched for at the same time.
        evaluate: computes points on the runs of the search.
        others: computes points on other runs.
    """
    sides = [_Side(p, up) for p in parameters for up in (False, True)]
    active = sides
    while active:
        wanted = [(side, factor) for side in active if (factor := side.next()) is not None]
        points = [side.parameter.changes(factor) for side, factor in wanted]
        for (side, factor), outcome in zip(wanted, evaluate(points) if points else ()):
            side.note(factor, outcome)
        active = [side for side, _ in wanted]
    ends = _confirmed(sides, others)
    return tuple(zip(ends[::2], ends[1::2]))


def _confirmed(sides: Sequence[_Side], others: Evaluate) -> list[End]:
    """The ends as other runs see them."""
    ends = [End(side.inner, side.outer, side.verdict, side.reason) for side in sides]
    open_ = list(range(len(ends)))
    for _ in range(TRIES):
        found = others([sides[i].parameter.changes(ends[i].factor) for i in open_]) if open_ else ()
        left = []
        for i, outcome in zip(open_, found):
            (verdict, reason), (_, nees) = _word(outcome), _size(outcome)
            if verdict == Verdict.CONSISTENT:
                ends[i] = replace(ends[i], nees=nees, confirmed=True)
                continue
            back = sides[i].parameter.possible(ends[i].factor ** BACK)
            if back == ends[i].factor:
                ends[i] = replace(ends[i], nees=nees)
                continue
            ends[i] = End(back, ends[i].factor, verdict, reason)
            left.append(i)
        open_ = left
    beyond = [i for i, end in enumerate(ends) if end.beyond is not None]
    points = [sides[i].parameter.changes(ends[i].beyond or 1.0) for i in beyond]
    for i, outcome in zip(beyond, others(points) if points else ()):
        ends[i] = replace(ends[i], nees_beyond=_size(outcome)[1])
    return ends


def _word(outcome: Outcome) -> tuple[str, str]:
    """The verdict, and what it is made from."""
    if outcome.summary is None:
        return "impossible", outcome.reason
    verdict = str(outcome.summary.verdict)
    return verdict, outcome.summary.reason.removeprefix(f"{verdict}: ")


def _size(outcome: Outcome) -> tuple[float, float]:
    return (np.nan, np.nan) if outcome.record is None else size(outcome.record)
