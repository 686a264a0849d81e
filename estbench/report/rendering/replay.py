"""One run to show: truth, estimate and covariance at every instant."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.consistency.nees import chi_square_band
from estbench.errors import EstbenchError, EstimatorError
from estbench.experiment import contact, setup
from estbench.montecarlo import run as experiment
from estbench.montecarlo.batch import traced
from estbench.report import contact as stored_contact
from estbench.report.sources import Entry, load, read
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.store.metadata import STORE


@dataclass(frozen=True, eq=False)
class Replay:
    """One run of one estimator.

    Attributes:
        name: name of the scenario.
        label: label of the estimator.
        run: number of the run.
        model: the true robot.
        times: `(K + 1,)`, s.
        truth: x `(K + 1, nx)`.
        estimate: x̂ `(K + 1, nx)`.
        cov: P `(K + 1, n, n)`; only its diagonal where `correlated` is False.
        nees: NEES/n `(K + 1,)`; NIS/m where the truth is not known.
        band: bounds of it of one run with a consistent estimator.
        level: probability of the band.
        correlated: whether the covariances between coordinates are known.
        touching: whether the true robot touches anything `(K + 1,)`; None where it cannot.
        events: kind -> times of the events of contact, s.
        what: `NEES/n` or `NIS/m`.
        log: whether it is of a recorded log, where the truth is NaN while it is not known.
    """

    name: str
    label: str
    run: int
    model: mujoco.MjModel
    times: Array
    truth: Array
    estimate: Array
    cov: Array
    nees: Array
    band: tuple[float, float]
    level: float
    correlated: bool
    touching: NDArray[np.bool_] | None = None
    events: Mapping[str, Array] = field(default_factory=dict)
    what: str = "NEES/n"
    log: bool = False


def replay(
    source: str | Path,
    run: int,
    estimator: str | None = None,
    overrides: Sequence[str] = (),
) -> Replay:
    """A run of a results folder, or of a scenario, which is simulated now.

    Args:
        source: results folder, bundled name, TOML or MJCF path.
        run: number of the run.
        estimator: label; default the first.
        overrides: `section.key=value` strings, for a scenario.

    Raises:
        EstbenchError: no such run or estimator, or a mistake in the scenario.
    """
    if run < 0:
        raise EstbenchError(f"--run is {run}; runs are numbered from 0")
    if (Path(source) / STORE).is_dir():
        if overrides:
            raise EstbenchError("--set changes a scenario, not results that are there already")
        entry = load([source], [estimator] if estimator else ())[0]
        if entry.position(run) is None:
            raise entry.no_run(run)
        return of_entry(entry, run)
    chosen = [estimator] if estimator else None
    scenario = experiment.resolve(source, chosen, overrides=overrides)
    return simulated(scenario, run, next(iter(scenario.estimators)))


def of_entry(entry: Entry, run: int) -> Replay:
    """A stored run; it is simulated again if no traces were kept.

    P comes from the store (`keep = full`), else from a new simulation of the run if that gives the
    stored estimate, else P is diagonal with the stored variances.
    """
    source = entry.source
    if source.log is not None:
        return of_log(entry, run)
    if not source.has_traces:
        return simulated(source.scenario, run, entry.label)
    place = entry.position(run)
    group = entry.group.isel(run=place)
    prepared = setup.build(source.scenario)
    estimate, std = group["estimate"].values, group["std"].values
    assert place is not None  # the caller has looked
    truth = stored_contact.truth(prepared, entry, [place])[:, 0]
    correlated = True
    if "cov" in group:
        cov = group["cov"].values
    else:
        again = _again(source.scenario, run, entry.label, estimate)
        correlated = again is not None
        cov = again if again is not None else std[:, :, None] ** 2 * np.eye(source.n)
    return _replay(
        prepared, entry.label, run, truth, estimate, cov, group["nees"].values,
        source.rank(group), correlated,
    )  # fmt: skip


def of_log(entry: Entry, run: int) -> Replay:
    """A replayed log; what is not known of the truth is that of the estimate."""
    source, group = entry.source, entry.group.isel(run=entry.position(run))
    prepared = setup.build(source.scenario)
    estimate = group["estimate"].values
    truth = read(source.tree, "truth/x")[0]
    known = np.isfinite(truth).any(axis=1)
    ratio, rank = group["nees"].values, source.rank(group)
    if not source.has_truth:  # the NIS of the last update
        ratio, rank = group["nis"].values, group["dof"].values
        last = np.maximum.accumulate(np.where(rank > 0, np.arange(len(rank)), 0))
        ratio, rank = ratio[last], rank[last]
    usual, level = max(1, int(np.median(rank))), source.level
    low, high = chi_square_band(usual, 1, level)
    filled = np.where(np.isfinite(truth), truth, estimate)
    return Replay(
        name=source.scenario.name, label=entry.label, run=run, model=prepared.plant.model,
        times=source.times, truth=np.where(known[:, None], filled, np.nan), estimate=estimate,
        cov=group["cov"].values, nees=ratio / np.maximum(rank, 1),
        band=(low / usual, high / usual), level=level, correlated=True,
        what="NEES/n" if source.has_truth else "NIS/m", log=True,
    )  # fmt: skip


def simulated(scenario: Scenario, run: int, label: str) -> Replay:
    """A run that is simulated now.

    Raises:
        EstimatorError: the scenario has no estimator of that label.
    """
    if label not in scenario.estimators:
        raise EstimatorError(f"no estimator '{label}' in {scenario.name}")
    chosen = scenario.model_copy(update={"estimators": {label: scenario.estimators[label]}})
    prepared = setup.build(chosen)
    ((_, traces),) = traced(prepared, [run], keep_cov=True)
    assert traces is not None
    assert traces.cov is not None
    return _replay(
        prepared, label, run, traces.truth[:, 0], traces.mean[:, 0], traces.cov[:, 0],
        traces.nees[:, 0], traces.rank[:, 0], True,
    )  # fmt: skip


def _again(scenario: Scenario, run: int, label: str, estimate: Array) -> Array | None:
    """P of a new simulation of the run, or None if its estimate is not the stored one."""
    try:
        other = simulated(scenario, run, label)
    except EstbenchError:
        return None
    same = other.estimate.shape == estimate.shape and np.allclose(
        other.estimate, estimate, rtol=1e-6, atol=1e-6, equal_nan=True
    )
    return other.cov if same else None


def _replay(
    prepared: setup.Setup, label: str, run: int, truth: Array, estimate: Array, cov: Array,
    nees: Array, rank: NDArray[np.int64], correlated: bool,
) -> Replay:  # fmt: skip
    contacts = contact.seen(prepared, truth[:, None], [run])
    level, usual = prepared.scenario.consistency.level, max(1, int(np.median(rank)))
    low, high = chi_square_band(usual, 1, level)
    return Replay(
        name=prepared.scenario.name,
        label=label,
        run=run,
        model=prepared.plant.model,
        times=prepared.times,
        truth=truth,
        estimate=estimate,
        cov=cov,
        nees=nees / np.maximum(rank, 1),
        band=(low / usual, high / usual),
        level=level,
        correlated=correlated,
        touching=None if contacts is None else contacts.touching[:, 0],
        events={} if contacts is None else contacts.times(prepared.times, 0),
    )
