"""Comparison of results folders: accuracy of each estimator, pairs, and a ranking with ties."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estbench.analysis.comparison import Pair, Paired, Rank, compare, paired
from estbench.analysis.findings import Findings, find
from estbench.analysis.load import load_all
from estbench.analysis.stored import Stored
from estbench.consistency.intervals import Interval, mean_interval
from estbench.consistency.scores import inexact, score
from estbench.errors import AnalysisError, StoreError
from estbench.shapes import Array

OWN = {"name", "description", "estimators", "filter", "consistency", "task", "bound"}
"""Sections of a scenario that change neither the truth nor the readings."""


@dataclass(frozen=True, eq=False)
class Contest:
    """Estimators with the same truth and readings, in one store or in several.

    Attributes:
        title: scenario, duration and seed.
        truth: whether it is known. Without it the scores are negative log-likelihoods per component
            of a reading, in place of logarithms of errors.
        stores: the folders.
        findings: one per estimator.
        runs: numbers of the runs that all stores have finished; pairs and ranks are over these. Of
            a log its parts.
        pairs: comparisons of the scores of all pairs.
        ranks: in order.
        nees: difference of NEES/n of each pair, over the runs in which neither diverged.
        log_likelihood: likewise of the log-likelihood, over the runs in which both received as many
            readings; NaN where there is none, or a store does not have it.
    """

    title: str
    truth: bool
    stores: tuple[Stored, ...]
    findings: tuple[Findings, ...]
    runs: NDArray[np.int64]
    pairs: tuple[Pair, ...]
    ranks: tuple[Rank, ...]
    nees: tuple[Interval, ...]
    log_likelihood: tuple[Interval, ...]
    _rows: tuple[NDArray[np.intp], ...]

    def details(self) -> Iterator[tuple[tuple[Paired, ...], Paired]]:
        """For each pair the comparison of RMSE per coordinate, and that of NEES/n."""
        level = self.stores[0].scenario.consistency.level
        place = {f.key: i for i, f in enumerate(self.findings)}
        values = [self._values(i) for i in range(len(self.findings))]
        for pair in self.pairs:
            (x, a), (y, b) = (values[place[key]] for key in (pair.a, pair.b))
            rmse = tuple(paired(p, q, level) for p, q in zip(x.T, y.T))
            yield rmse, paired(a, b, level)

    def _values(self, i: int) -> tuple[Array, Array]:
        """RMSE `(run, n)` and NEES/n `(run,)` of an estimator, infinite where the run diverged."""
        record, rows = self.findings[i].record, self._rows[i]
        lost = record["diverged"][rows].astype(bool)
        rmse = np.sqrt(np.where(lost[:, None], np.inf, record["mse"][rows]))
        return rmse, np.where(lost, np.inf, record["anees"][rows])


@dataclass(frozen=True, eq=False)
class Comparison:
    """The result of `estbench compare`.

    Attributes:
        contests: one for each scenario and seed among the stores.
        level: confidence.
        margin: a relative difference that is too small to matter.
        precision: wanted half-width, for the number of runs needed.
    """

    contests: tuple[Contest, ...]
    level: float
    margin: float
    precision: float


def compare_stores(
    folders: Sequence[str | Path], margin: float = 0.01, precision: float = 0.02
) -> Comparison:
    """Read results folders and compare their estimators.

    Stores of one scenario and seed are compared run by run, even if the assumptions of the filters
    differ (`filter`, `consistency` and the estimators' settings).

    Args:
        folders: written by `estbench run`; of unfinished ones the finished runs count.
        margin: a relative difference of errors that is too small to matter.
        precision: wanted relative half-width of RMSE, and half-width of ANEES/n.

    Raises:
        StoreError: a folder is no store, has no finished run, is named twice, or the stores are of
            different robots.
        AnalysisError: a setting is out of range.
    """
    for name, value in (("margin", margin), ("precision", precision)):
        if not 0 < value < 1:
            raise AnalysisError(f"{name} is {value:g}; use a number between 0 and 1")
    groups: dict[str, list[Stored]] = {}
    for stored in load_all(folders):
        groups.setdefault(_same(stored), []).append(stored)
    level = next(iter(groups.values()))[0].level
    contests = tuple(_contest(members, level, margin, precision) for members in groups.values())
    return Comparison(contests, level, margin, precision)


def _contest(stores: Sequence[Stored], level: float, margin: float, precision: float) -> Contest:
    findings = [
        find(s, label, label if len(stores) == 1 else f"{s.title}/{label}", precision)
        for s in stores
        for label in s.records
    ]
    first, truth = stores[0], all(s.has_truth for s in stores)
    runs = np.arange(len(findings[0].record["anis"])) if first.log else first.runs
    for s in stores[1:] if first.log is None else ():
        runs = np.intersect1d(runs, s.runs)
    if not len(runs):
        raise StoreError(
            f"{', '.join(str(s.folder) for s in stores)} have no finished run in common; "
            "compare them one by one"
        )
    rows = tuple(
        runs if first.log else np.flatnonzero(np.isin(f.stored.runs, runs)) for f in findings
    )
    scores, anees, likely, received = {}, {}, {}, {}
    compared = inexact([f.record for f in findings])
    for f, where in zip(findings, rows):
        lost = f.record["diverged"][where].astype(bool)
        scores[f.key] = (
            score(f.record["mse"][where][:, compared], lost) if truth else _surprise(f, lost)
        )
        anees[f.key] = np.where(lost, np.nan, f.record["anees"][where])
        likely[f.key] = np.where(lost, np.nan, _optional(f, "log_likelihood")[where])
        received[f.key] = _optional(f, "received")[where]
    pairs, ranks = compare(scores, level, margin)
    length = f"{first.times[-1]:g} s ({first.instants} instants)"
    seed = first.scenario.simulation.seed
    return Contest(
        title=f"{first.scenario.name}: "
        + (
            f"{first.origin}, {length}"
            if first.log
            else f"{len(runs)} runs x {length}, seed {seed}"
        ),
        truth=truth,
        stores=tuple(stores),
        findings=tuple(findings),
        runs=runs,
        pairs=tuple(pairs),
        ranks=tuple(ranks),
        nees=tuple(mean_interval(anees[p.a] - anees[p.b], level) for p in pairs),
        log_likelihood=tuple(
            mean_interval((likely[p.a] - likely[p.b])[received[p.a] == received[p.b]], level)
            for p in pairs
        ),
        _rows=rows,
    )


def _surprise(f: Findings, lost: NDArray[np.bool_]) -> Array:
    """The negative log-likelihood of each part of a log, per component of a reading."""
    parts = len(f.record["received"])  # by which the log-likelihood of a part is multiplied
    received = np.maximum(f.record["received"], 1)
    return np.where(lost, np.inf, -f.record["log_likelihood"] / parts / received)


def _optional(f: Findings, name: str) -> Array:
    """A variable of each run; NaN if the store is of an earlier version."""
    values = f.record.get(name, np.full(len(f.record["anees"]), np.nan))
    return np.asarray(values, np.float64)


def _same(stored: Stored) -> str:
    """A text that is the same for two stores whose runs can be paired."""
    if stored.log is not None:  # the same readings of one log; the models may differ
        return repr({k: v for k, v in stored.log.items() if k != "files"} | {
            "instants": len(stored.times), "channels": stored.channels,
            "parts": len(next(iter(stored.samples.values()))["anis"]),
            "burn_in": stored.scenario.consistency.burn_in,
        })  # fmt: skip
    dump = stored.scenario.model_dump(mode="json", exclude=OWN)
    del dump["simulation"]["runs"]
    return repr(dump)
