"""When the runs are enough: rules that end an experiment before its last run.

The rule is asked at fixed counts of runs, whatever the machine and its workers, so that a run and
the result do not depend on them. What repeated looks do to intervals and to the rate of false
alarms is simulated in `benchmarks/stopping.py`; docs/statistics.md states it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estbench.consistency.intervals import Interval, runs_needed
from estbench.consistency.scores import difference, inexact, score
from estbench.consistency.verdict import MANY, Verdict
from estbench.errors import EstimatorError, ScenarioError, did_you_mean, shown
from estbench.montecarlo.results import Results
from estbench.scenario.schema import Scenario
from estbench.shapes import Array

BATCH = 50
"""Runs of a batch at most, and of the first look: with fewer the spread is not known."""
GROWTH = 1.25
"""Factor between the counts of runs of two looks at least."""


@dataclass(frozen=True)
class Rule:
    """Runs are added until all that is asked for is known.

    Attributes:
        precision: half-width of the interval of NEES/n of every estimator, or of that of `pair`;
            None where it is not asked for.
        pair: labels of two estimators: the precision is that of the logarithm of the ratio of their
            RMSE, the geometric mean over the coordinates.
        decided: whether no verdict may be undecided.
    """

    precision: float | None
    pair: tuple[str, str] | None
    decided: bool

    def met(self, results: Results) -> bool:
        """Whether the runs are enough."""
        if self.decided and any(s.verdict is Verdict.UNDECIDED for s in results.summaries):
            return False
        return self.precision is None or max(self.widths(results).values()) <= self.precision

    def widths(self, results: Results) -> dict[str, float]:
        """What is to be known -> half-width of its interval; infinite where there is none."""
        if self.pair is None:
            return {f"NEES/n of {s.label}": _half(s.anees) for s in results.summaries}
        level = results.scenario.consistency.level
        return {
            f"RMSE of {' / '.join(self.pair)}": _half(difference(*self._scores(results), level))
        }

    def said(self, results: Results, most: int) -> str:
        """One line: after how many runs it ended, what is known then, and what is not."""
        count = len(results.runs)
        end = f"{count} of at most {most} runs" if count < most else f"all {count} runs"
        if self.precision is None:
            return f"{end} were needed to decide" if self.met(results) else f"{end} do not decide"
        widths = self.widths(results)
        known = ", ".join(f"{name} ± {width:.2g}" for name, width in widths.items())
        if max(widths.values()) <= self.precision:
            return f"stopped after {end}: {known}"
        needed = self._needed(results)
        more = "" if needed is None else f"; some {needed} runs would do"
        return f"{end} do not give ± {self.precision:g}: {known}{more}"

    def _needed(self, results: Results) -> int | None:
        """Runs that would give the precision, by the spread of those that there are."""
        level = results.scenario.consistency.level
        if self.pair is not None:
            a, b = self._scores(results)
            values = [np.subtract(a, b, where=np.isfinite(a + b), out=np.full(len(a), np.nan))]
        else:
            values = [np.where(r["diverged"], np.nan, r["anees"]) for r in results.records.values()]
        found = [runs_needed(v, self.precision or 0.0, level) or math.inf for v in values]
        return int(max(found)) if max(found) <= MANY else None

    def _scores(self, results: Results) -> tuple[Array, Array]:
        """The scores of the pair in each run."""
        records = [results.records[label] for label in self.pair or ()]
        where = inexact(records)
        a, b = (score(r["mse"][:, where], r["diverged"].astype(bool)) for r in records)
        return a, b


def rule(
    precision: float | None,
    pair: tuple[str, str] | None,
    decided: bool,
    scenario: Scenario,
) -> Rule | None:
    """The rule that the arguments of `estbench.run` mean; None where every run is wanted.

    Args:
        precision: half-width.
        pair: labels of two estimators.
        decided: whether to stop when no verdict is undecided.
        scenario: as resolved; it names the estimators.

    Raises:
        ScenarioError: the precision is not positive, or missing; or no verdict is ever decided.
        EstimatorError: the pair does not name two of the estimators.
    """
    if not isinstance(decided, bool):
        raise ScenarioError(f"until_decided is {shown(decided)}; use True or False")
    if decided and not scenario.consistency.tolerance:
        raise ScenarioError(
            "until_decided has no end with consistency.tolerance 0: no estimator is shown to be "
            "consistent, and one in five is refused by chance; use --precision"
        )
    if pair is not None and precision is None:
        raise ScenarioError(
            f"precision_of is {shown(pair)} without a precision; add --precision 0.02"
        )
    if precision is None:
        return Rule(None, None, True) if decided else None
    number = isinstance(precision, int | float) and not isinstance(precision, bool)
    if not (number and 0 < precision < math.inf):
        raise ScenarioError(
            f"precision is {shown(precision)}; use a positive half-width, e.g. 0.02"
        )
    texts = isinstance(pair, tuple | list) and all(isinstance(x, str) for x in pair)
    if pair is not None and not (texts and len(pair) == len(set(pair)) == 2):
        raise EstimatorError(
            f"precision_of is {shown(pair)}; use the labels of two estimators, e.g. ekf,ukf"
        )
    labels = scenario.estimators
    for label in pair or ():
        if label not in labels:
            raise EstimatorError(
                f"precision_of names '{label}', which is not run{did_you_mean(label, labels)}"
            )
    return Rule(precision, pair, decided)


def looks(size: int, most: int, begun: int = 0) -> Iterator[int]:
    """The counts of runs at which a rule is asked, the last one `most`.

    Whole batches, each count at least `GROWTH` times the one before.

    Args:
        size: runs of a batch.
        most: runs at most.
        begun: runs of a store that is continued, which are looked at first.
    """
    batches = 1
    while batches * size < most:
        if batches * size >= begun:
            yield batches * size
        batches = max(batches + 1, math.ceil(GROWTH * batches))
    yield most


def _half(x: Interval) -> float:
    """Half of the width of an interval; infinite where there is none."""
    half = (x.high - x.low) / 2
    return half if math.isfinite(half) else math.inf
