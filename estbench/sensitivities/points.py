"""Scenarios that differ in a few keys, computed as studies: one truth for those that share it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

from estbench.consistency.fields import Record
from estbench.consistency.statistics import Summary
from estbench.errors import EstbenchError, Interrupted
from estbench.experiment.setup import build
from estbench.montecarlo.dispatch import Progress
from estbench.scenario.schema import Scenario
from estbench.sensitivities.parameter import Changes
from estbench.study import keys, run
from estbench.study.axes import Axis
from estbench.study.design import Study, truth_key
from estbench.study.findings import Findings


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one point gave.

    Attributes:
        record: of the estimator's runs; None where it could not be run.
        reason: why it could not be run, else "".
        summarized: gives the summary of the record.
    """

    record: Record | None
    reason: str = ""
    summarized: Callable[[], Summary] | None = None

    @cached_property
    def summary(self) -> Summary | None:
        """Of the record."""
        return None if self.summarized is None else self.summarized()


@dataclass(frozen=True)
class Using:
    """Runs per batch, threads, and who is told of finished runs."""

    batch_size: int
    workers: int | None
    progress: Progress


def computed(
    scenario: Scenario,
    points: Sequence[Changes],
    batch_size: int,
    workers: int | None = None,
    progress: Progress | None = None,
) -> list[Outcome]:
    """What an estimator does at some points, each on the same runs and random numbers.

    Those that differ in what the filter believes share truth and readings.

    Args:
        scenario: with one estimator.
        points: keys and values that change; none is the scenario itself.
        batch_size: runs per batch.
        workers: count of threads.
        progress: called with the count of finished runs of points, and of all.

    Raises:
        Interrupted: Ctrl-C came.
        EstbenchError: no point can be run.
    """
    own = truth_key(keys.changed(scenario, {}))
    out: list[Outcome | None] = [None] * len(points)
    groups: tuple[list[int], list[int]] = ([], [])
    for i, point in enumerate(points):
        try:
            groups[truth_key(keys.changed(scenario, point)) != own].append(i)
        except EstbenchError as error:
            out[i] = Outcome(None, str(error))
    done, total = 0, scenario.simulation.runs * len(points)

    def note(count: int, _: int) -> None:
        if progress is not None:
            progress(done + count, total)

    for group in groups:
        using = Using(batch_size, workers, note)
        for i, outcome in zip(group, _study(scenario, [points[i] for i in group], using)):
            out[i] = outcome
        done += scenario.simulation.runs * len(group)
    if progress is not None:
        progress(total, total)
    return [outcome for outcome in out if outcome is not None]


def _study(scenario: Scenario, points: Sequence[Changes], using: Using) -> list[Outcome]:
    """The points as one study; those that cannot be built are left out of it."""
    if not points:
        return []
    try:
        return _outcomes(_run(scenario, points, using))
    except Interrupted:
        raise
    except EstbenchError:
        reasons = [_refusal(scenario, point) for point in points]
        if not any(reasons):
            raise
    left = [point for point, reason in zip(points, reasons) if not reason]
    found = iter(_outcomes(_run(scenario, left, using)) if left else ())
    return [Outcome(None, reason) if reason else next(found) for reason in reasons]


def _refusal(scenario: Scenario, point: Changes) -> str:
    """Why a point cannot be built; empty if it can."""
    try:
        build(keys.changed(scenario, point))
    except EstbenchError as error:
        return str(error)
    return ""


def _run(scenario: Scenario, points: Sequence[Changes], using: Using) -> Findings:
    names: Mapping[keys.Names, Any] = {name: None for point in points for name in point}
    axes = [Axis(name, tuple(point.get(name) for point in points)) for name in names]
    # A study has an axis: one that leaves the scenario as it is.
    axes = axes or [Axis(("bound",), (scenario.bound,) * len(points))]
    found = run.run(
        Study(scenario, tuple(axes), grid=False), workers=using.workers,
        batch_size=using.batch_size, progress=using.progress,
    )  # fmt: skip
    if found.interrupted:
        raise Interrupted("interrupted before all variants were finished: there is no result")
    return found


def _outcomes(found: Findings) -> list[Outcome]:
    (label,) = found.study.labels
    return [
        Outcome(None, found.failures[i, label])
        if (i, label) in found.failures
        else Outcome(record[label], summarized=partial(found.summary, i, label))
        for i, record in enumerate(found.records)
    ]
