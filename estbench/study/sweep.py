"""`estbench.sweep`: estimators over a grid or a design of keys; a Dataset and a table."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from estbench.consistency import statistics
from estbench.consistency.statistics import LAG_ONE, RMSE
from estbench.errors import StudyError
from estbench.montecarlo.dispatch import Progress
from estbench.scenario.load import Chosen, resolve
from estbench.scenario.schema import Scenario
from estbench.study import axes, keys
from estbench.study import run as running
from estbench.study.axes import Axis, Range
from estbench.study.design import Study
from estbench.study.findings import Findings
from estbench.study.run import Executor
from estbench.tables.cells import cell, value_of
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number

Over = Mapping[str, str | Sequence[Any]] | Sequence[str]
"""Key -> SPEC of the command line or a list of values; or a list of `KEY=SPEC`."""
POINTS = 32
"""Of a design, unless another count is asked for."""


def sweep(
    scenario: str | Path | Scenario,
    over: Over,
    estimators: Chosen | None = None,
    *,
    sample: axes.Sample | None = None,
    points: int = POINTS,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    resume: bool = False,
    shard: tuple[int, int] | None = None,
    executor: Executor = "threads",
    address: str | None = None,
    workers: int | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Run estimators for every combination of the values of some keys, on the same runs.

    Variants that differ only in what the filters believe or in the estimators share truth and
    readings, which are simulated once; all variants have common random numbers.

    Examples:
        >>> import estbench
        >>> q = {"filter.process_noise_scale": [0.1, 1]}
        >>> found = estbench.sweep("pendulum", q, ["ekf"], runs=20, duration=1.0)
        >>> float(found.log_likelihood.sel(estimator="ekf").idxmax("filter.process_noise_scale"))
        1.0

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        over: the varied keys with their values, or with `lin:a:b:n` or `log:a:b:n`.
        estimators: labels, names or classes, in place of the scenario's.
        sample: `sobol` or `latin`: points spread over the ranges, in place of a grid.
        points: count of these points.
        runs: Monte Carlo runs of each variant, in place of the scenario's.
        seed: in place of the scenario's.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings, for all variants.
        out: folder of the store; None writes nothing.
        resume: continue `out` if it exists.
        shard: (i, n) computes the i-th of n shares into one store.
        executor: as for `estbench.run`.
        address: of the dask scheduler.
        workers: count of threads or processes.
        batch_size: runs per batch; it does not change the results.
        progress: called with the count of finished runs of variants, and of all.

    Returns:
        Statistics with the varied keys and `estimator` as dimensions; see `Findings.dataset`.

    Raises:
        StudyError: a key does not exist or is not free to vary, or a range is empty.
        EstbenchError: the input is wrong otherwise; nothing has been written.
    """
    study = design(
        resolve(scenario, estimators, runs, seed, duration, overrides), over, sample, points
    )
    return running.run(
        study, out=out, resume=resume, shard=shard, executor=executor, address=address,
        workers=workers, batch_size=batch_size, progress=progress,
    ).dataset()  # fmt: skip


def design(
    scenario: Scenario, over: Over, sample: axes.Sample | None = None, points: int = POINTS
) -> Study:
    """The study of a sweep; for the arguments see `sweep`.

    Raises:
        StudyError: a key does not exist or is not free to vary, or a range is empty.
    """
    specs = [_spec(key, given) for key, given in over.items()] if isinstance(over, Mapping) else [
        axes.parse(text) for text in over
    ]  # fmt: skip
    if sample is None:
        study = Study(scenario, axes.grid(specs))
    else:
        seed = scenario.simulation.seed
        study = Study(scenario, axes.points(specs, sample, points, seed), grid=False)
    _ = study.variants  # mistakes are found before anything is built
    return study


def _spec(key: str, given: str | Sequence[Any]) -> tuple[keys.Names, Range | tuple[Any, ...]]:
    if isinstance(given, str):
        return axes.parse(f"{key}={given}")
    try:
        return keys.parse(key), tuple(given)
    except TypeError:
        raise StudyError(f"'{key}' is {given!r}; give a list of values, or {axes.FORMS}") from None


def table(findings: Findings) -> Table:
    """One row per variant and estimator: the varied keys, the verdict, statistics, RMSE."""
    study = findings.study
    shown = [s for s in statistics.shown("run") if s.form != "number" and s is not LAG_ONE]
    rows = [
        (i, label, by_label[label])
        for i, by_label in enumerate(findings.summaries)
        for label in study.labels
    ]
    columns = [
        Column(axis.key, tuple(_value(axis, study, i) for i, _, _ in rows)) for axis in study.axes
    ]
    columns.append(Column("estimator", tuple(label for _, label, _ in rows), "left"))
    groups: list[tuple[Column, ...]] = [
        (Column("verdict", tuple(str(s.verdict) for _, _, s in rows), "left"),)
    ]
    for statistic in shown:
        cells = tuple(
            cell(statistic, value_of(s, statistic), statistic.places["run"]) for _, _, s in rows
        )
        heading = statistic.heading_in("run")
        groups.append((Column(heading, cells, narrow=statistic.narrow),))
    for k, (name, unit) in enumerate(zip(findings.names, findings.units)):
        cells = tuple(number(value_of(s, RMSE)[k].value) for _, _, s in rows)
        groups.append((Column(f"RMSE {name} [{unit}]", cells, narrow=f"{name}\n[{unit}]"),))
    level = study.scenario.consistency.level
    note = (
        f"{statistics.ideals('run')}, for a consistent filter; ±: the {level:.0%} interval across "
        "runs; RMSE over time and the runs that did not diverge"
    )
    return Table(tuple(columns), tuple(groups), note=note)


def _value(axis: Axis, study: Study, variant: int) -> str:
    """The value of a key in one variant."""
    place = study.axes.index(axis)
    at = int(_position(study, variant)[place]) if study.grid else variant
    value = axis.values[at]
    real = isinstance(value, int | float) and not isinstance(value, bool)
    return f"{value:.4g}" if real else str(value)


def _position(study: Study, variant: int) -> tuple[int, ...]:
    out = []
    for length in reversed(study.shape):
        variant, at = divmod(variant, length)
        out.append(at)
    return tuple(reversed(out))
