"""`estbench.sensitivity`: how much each number of a scenario matters to an estimator."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estbench.budgets.budget import one
from estbench.errors import StudyError
from estbench.experiment.setup import build
from estbench.montecarlo import batch, executors
from estbench.montecarlo.dispatch import Progress
from estbench.scenario.load import resolve
from estbench.scenario.schema import Scenario
from estbench.sensitivities import indices as sobol_indices
from estbench.sensitivities.choice import chosen
from estbench.sensitivities.discovery import parameters
from estbench.sensitivities.elasticity import of_records, size
from estbench.sensitivities.parameter import Changes, Parameter
from estbench.sensitivities.points import Outcome, computed
from estbench.sensitivities.ranges import check
from estbench.sensitivities.ranges import ranges as searched
from estbench.sensitivities.result import Curve, Sensitivity, Slope

STEP = 0.1
"""Relative change of a parameter in its elasticity."""
WIDE = (0.25, 0.35, 0.5, 0.71, 1.0, 1.41, 2.0, 2.83, 4.0)
"""Factors of the curves."""
POINTS = 20
"""About so many for the two ends of a range."""
MOST = 6
"""Parameters of the Sobol indices, where the user names none."""


def sensitivity(
    scenario: str | Path | Scenario,
    estimator: str | type | None = None,
    *,
    key: Sequence[str] = (),
    by_source: bool = False,
    step: float = STEP,
    curves: int = 0,
    ranges: bool = False,
    sobol: int | None = None,
    spread: float = 2.0,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    progress: Progress | None = None,
) -> Sensitivity:
    """How much each number that a filter believes, or that the hardware has, matters.

    Elasticities d log RMSE / d log θ and d log NEES / d log θ by central differences, on paired
    runs. A parameter of the filter (`filter...`, `start...`, a setting of the estimator) changes
    what it believes, which becomes wrong; one of the hardware changes robot and belief alike. See
    docs/sensitivity.md.

    Examples:
        >>> import estbench
        >>> found = estbench.sensitivity(
        ...     "pendulum", key=["channels.*.noise"], runs=20, duration=0.5).dataset()
        >>> found.rmse.idxmax("parameter").item()
        'channels.gyro.noise'

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimator: a label, name or class; default the scenario's first.
        key: patterns of the parameters, e.g. `filter.*`; default all. `KEY=lin:LOW:HIGH` and
            `KEY=log:LOW:HIGH` give a range for the Sobol indices.
        by_source: whether each coordinate of P₀ and each component of the process noise is a
            parameter; else these are multiplied as a whole.
        step: relative change of the parameters, (0, 1).
        curves: how many parameters, those that matter most, get a curve over factors of 1/4 to 4.
        ranges: whether to search the range of each parameter in which the verdict stays consistent;
            without `key` of what the filter believes.
        sobol: points of each matrix of the Sobol indices, a power of two; None for no indices.
            Without `key` of the six parameters that matter most.
        spread: factor below and above each value over which the indices are, without a range.
        runs: in place of the scenario's.
        seed: in place of the scenario's; the confirmation of the ranges has the next one.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings.
        workers: count of threads.
        progress: called with the count of finished runs of variants, and of all known so far.

    Raises:
        StudyError: a key or a number is wrong, or the verdict is not consistent.
        EstbenchError: the input is wrong otherwise.
    """
    named = None if estimator is None else [estimator]
    resolved = one(resolve(scenario, named, runs, seed, duration, overrides))
    return of_scenario(
        resolved, key=key, by_source=by_source, step=step, curves=curves, ranges=ranges,
        sobol=sobol, spread=spread, workers=workers, progress=progress,
    )  # fmt: skip


def of_scenario(
    scenario: Scenario,
    *,
    key: Sequence[str] = (),
    by_source: bool = False,
    step: float = STEP,
    curves: int = 0,
    ranges: bool = False,
    sobol: int | None = None,
    spread: float = 2.0,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Sensitivity:
    """As `sensitivity`, of a scenario with one estimator."""
    if not 0 < step < 1:
        raise StudyError(f"--step is {step:g}; use a relative change between 0 and 1, e.g. 0.1")
    if curves < 0:
        raise StudyError(f"--curves is {curves}; use a count of at least 0")
    if scenario.simulation.runs < 2:
        raise StudyError("--runs is 1, which gives no intervals; use at least 2")
    scenario = scenario.model_copy(update={"bound": False})
    setup = build(scenario)
    (label,) = scenario.estimators
    asked = chosen(parameters(setup, label, by_source), key, setup.scenario)
    if sobol is not None:
        sobol_indices.check(sobol, spread, len(asked))
    # All variants have the same batches, one per thread.
    parts = workers or executors.cpu_count()
    size = batch.default_batch_size(setup, "summary", parts)
    searched_for = [p for p in asked if key or p.side == "filter"] if ranges else []
    points = 1 + 2 * len(asked) + len(WIDE) * curves + POINTS * len(searched_for)
    points += 0 if sobol is None else sobol * (2 + min(len(asked), len(asked) if key else MOST))
    count = _Count(progress, points * scenario.simulation.runs)
    evaluate = _Evaluate(setup.scenario, size, workers, count)
    level, notices = scenario.consistency.level, list(setup.notices)
    if ranges:
        check(*evaluate([{}]))
    slopes = _slopes(asked, evaluate, step, level, notices)
    matter = [s.parameter for s in slopes]
    ended = [p for p in matter if p in searched_for]
    bends = searched(ended, evaluate, evaluate.with_other_runs()) if ranges else ()
    found = None
    if sobol is not None:
        varied = asked if key else matter[:MOST]
        seed = scenario.simulation.seed
        found = sobol_indices.indices(varied, evaluate, sobol, spread, seed, level)
    wide = _curves(matter[:curves], evaluate)
    count.finish()
    return Sensitivity(
        scenario.name, label, setup.space.names, setup.space.units, scenario.simulation.runs,
        level, step, slopes, wide,
        tuple((p, *ends) for p, ends in zip(ended, bends)), found, tuple(notices),
    )  # fmt: skip


class _Evaluate:
    """Computes points of one scenario.

    Args:
        scenario: with one estimator.
        batch_size: runs per batch.
        workers: count of threads.
        progress: told of finished runs.
    """

    def __init__(
        self, scenario: Scenario, batch_size: int, workers: int | None, progress: "_Count"
    ):
        self._scenario, self._size, self._workers = scenario, batch_size, workers
        self._progress = progress

    def __call__(self, points: Sequence[Changes]) -> list[Outcome]:
        before = self._progress.done
        found = computed(
            self._scenario, points, self._size, self._workers,
            lambda done, _: self._progress(before + done),
        )  # fmt: skip
        self._progress(before + len(points) * self._scenario.simulation.runs)
        return found

    def with_other_runs(self) -> "_Evaluate":
        """The same with the next seed."""
        section = self._scenario.simulation
        other = section.model_copy(update={"seed": section.seed + 1})
        scenario = self._scenario.model_copy(update={"simulation": other})
        return _Evaluate(scenario, self._size, self._workers, self._progress)


@dataclass
class _Count:
    """How many runs are finished, of how many are expected.

    Attributes:
        told: called with both; None for nobody.
        expected: runs of all points; of a search, about.
        done: finished so far.
    """

    told: Progress | None
    expected: int
    done: int = 0

    def __call__(self, done: int) -> None:
        self.done = done
        self.expected = max(self.expected, done + 1)
        if self.told is not None:
            self.told(done, self.expected)

    def finish(self) -> None:
        """All runs are finished."""
        if self.told is not None:
            self.told(self.done, self.done)


def _slopes(
    parameters: Sequence[Parameter],
    evaluate: Callable[[Sequence[Changes]], list[Outcome]],
    step: float,
    level: float,
    notices: list[str],
) -> tuple[Slope, ...]:
    """The elasticities of the parameters, the largest first."""
    pairs = [(p, p.neighbours(1 + step)) for p in parameters if np.any(p.value)]
    points = [p.changes(factor) for p, factors in pairs for factor in factors]
    found = evaluate([{}, *points])
    own, around = found[0], found[1:]
    if own.record is None:
        raise StudyError(own.reason)
    out = []
    for (p, factors), ends in zip(pairs, zip(around[::2], around[1::2])):
        # A value that is impossible on one side leaves the difference to the value as it is.
        sides = [
            (own.record, 1.0) if end.record is None or factor == 1 else (end.record, factor)
            for end, factor in zip(ends, factors)
        ]
        (low, a), (high, b) = sides
        if a == b:
            notices.append(f"{p.key} is left out: {ends[0].reason or ends[1].reason}")
            continue
        rmse, nees, each, lost = of_records(low, high, b / a, level)
        out.append(Slope(p, (a, b), rmse, nees, each, lost))
    lost = {slope.parameter.key: slope.lost for slope in out if slope.lost}
    if lost:
        worst = max(lost, key=lambda name: lost[name])
        notices.append(f"runs that diverged are left out, at most {lost[worst]} ({worst})")
    return tuple(sorted(out, key=lambda slope: -slope.largest))


def _curves(
    parameters: Sequence[Parameter], evaluate: Callable[[Sequence[Changes]], list[Outcome]]
) -> tuple[Curve, ...]:
    """The parameters over a wide range."""
    if not parameters:
        return ()
    factors = [list(dict.fromkeys(p.possible(f) for f in WIDE)) for p in parameters]
    points = [p.changes(f) for p, own in zip(parameters, factors) for f in own if f != 1]
    own, *rest = evaluate([{}, *points])
    found = iter(rest)
    assert own.record is not None  # the elasticities have been computed from it
    base, _ = size(own.record)
    out = []
    for p, row in zip(parameters, factors):
        at = [own if f == 1 else next(found) for f in row]
        sizes = np.array([(np.nan, np.nan) if o.record is None else size(o.record) for o in at])
        lost = np.array([np.nan if o.record is None else o.record["diverged"].mean() for o in at])
        short = (0, len(WIDE) - len(row))
        padded = [np.pad(np.asarray(a, np.float64), short, constant_values=np.nan)
                  for a in (row, sizes[:, 0] / base, sizes[:, 1], lost)]  # fmt: skip
        out.append(Curve(p, *padded))
    return tuple(out)
