"""The numbers behind the figures: per-step means with bands, chosen runs.

Statistics are over all finished runs that did not diverge. `thin` and `choose_runs` select what is
drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estbench.analysis.findings import inside_shares
from estbench.consistency.coverage import Coverage
from estbench.consistency.coverage import coverage as shares_inside
from estbench.consistency.intervals import normal_mean_square_bounds, positive_mean_bounds
from estbench.consistency.nees import chi_square_band
from estbench.report.sources import Entry
from estbench.shapes import Array

POINTS = 1000
"""Most instants drawn of one curve."""


@dataclass(frozen=True, eq=False)
class Steps:
    """A mean over runs at each step, and the band of a consistent filter.

    Attributes:
        time: `(k,)` s.
        mean, low, high: `(k,)`, as a ratio to the degrees of freedom: 1 is consistent.
        counts: steps that count in the share `(k,)`.
        expected: share of the steps expected outside.
    """

    time: Array
    mean: Array
    low: Array
    high: Array
    counts: NDArray[np.bool_]
    expected: float

    @property
    def out(self) -> NDArray[np.bool_]:
        """Steps that count and whose mean is outside the band `(k,)`."""
        with np.errstate(invalid="ignore"):
            return self.counts & ((self.mean < self.low) | (self.mean > self.high))

    @property
    def outside(self) -> float:
        """Share of the steps whose mean is outside; NaN where none counts."""
        total = int(self.counts.sum())
        return float(self.out.sum() / total) if total else np.nan

    def worst_window(self, part: float = 0.1) -> tuple[float, float, float]:
        """The worst window of length `part` of the time: start, end, s, and share outside."""
        window = max(1, round(part * len(self.time)))
        total = np.concatenate([[0], np.cumsum(self.out)])
        count = np.concatenate([[0], np.cumsum(self.counts)])
        inside = count[window:] - count[:-window]
        share = (total[window:] - total[:-window]) / np.maximum(inside, 1)
        start = int(share.argmax())
        return float(self.time[start]), float(self.time[start + window - 1]), float(share[start])


def coverage(entry: Entry) -> tuple[Coverage, ...] | None:
    """Coverage of each coordinate across runs; None for stores of older versions."""
    shares = inside_shares(entry.sample)
    if shares is None or not entry.source.has_truth:
        return None
    each = shares[~entry.sample["diverged"].astype(bool)].swapaxes(0, 1)
    return tuple(shares_inside(runs, entry.source.level) for runs in each)


def nees_steps(entry: Entry) -> Steps:
    """NEES/n averaged over the runs at each instant, with its chi-square band."""
    record = entry.record
    runs = record["count"].sum(axis=0)
    if "rank_sum" in record:
        dof = record["rank_sum"].sum(axis=0) / np.maximum(runs, 1)
    else:  # an older store: P has full rank
        dof = np.full(len(runs), float(entry.source.n))
    found = _steps(entry, record["nees_sum"].sum(axis=0), dof, runs)
    if entry.source.log is None:
        return found
    return replace(found, counts=found.counts & np.isfinite(found.mean))  # truth may have gaps


def nis_steps(entry: Entry) -> Steps:
    """NIS/m averaged over the runs at each instant with readings, with its chi-square band."""
    record = entry.record
    runs = record["count"].sum(axis=0)
    dof = record["dof_sum"].sum(axis=0) / np.maximum(runs, 1)
    return _steps(entry, record["nis_sum"].sum(axis=0), dof, runs)


def _steps(entry: Entry, total: Array, dof: Array, runs: Array) -> Steps:
    source = entry.source
    used = (dof > 0) & (runs > 0)
    low, high = chi_square_band(dof[used], runs[used], source.level)
    return Steps(
        source.times[used], total[used] / (dof * runs)[used], low / dof[used], high / dof[used],
        source.settled[used], 1 - source.level,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Rmse:
    """RMSE over the runs at each instant, and σ that the filter reports.

    Attributes:
        time: `(K + 1,)` s.
        rmse, sigma: root mean square error and root mean variance `(K + 1, n)`, in the unit.
        low, high: interval of the RMSE `(K + 1, n)`, or NaN.
        exact: whether the interval is across runs (from traces), or assumes normal errors.
    """

    time: Array
    rmse: Array
    sigma: Array
    low: Array
    high: Array
    exact: bool


def rmse_steps(entry: Entry, fourth: Array | None = None) -> Rmse:
    """RMSE over time with an interval at each step.

    Args:
        entry: the estimator.
        fourth: sum over the runs of the fourth power of the error `(K + 1, n)`, if traces were
            stored. The interval is then `intervals.positive_mean_interval` of the squared error
            across runs, as in the tables. Without it the errors are taken to be normal.
    """
    record, level = entry.record, entry.source.level
    runs = record["count"].sum(axis=0)[:, None]
    square = record["square_sum"].sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mse = square / runs
        sigma = np.sqrt(record["variance_sum"].sum(axis=0) / runs)
        if fourth is not None:
            variance = np.maximum(fourth / runs - mse**2, 0.0) * runs / (runs - 1)
            low, high = positive_mean_bounds(mse, variance, runs, level)
        else:
            low, high = normal_mean_square_bounds(square, runs, level)
        return Rmse(
            entry.source.times, np.sqrt(mse), sigma,
            np.sqrt(np.maximum(low, 0.0)), np.sqrt(high), fourth is not None,
        )  # fmt: skip


def thin(values: Array, points: int = POINTS) -> NDArray[np.intp]:
    """Indices of at most `points` values, with the least and the greatest of each bucket.

    Args:
        values: `(k,)` or `(k, series)`; several series are thinned together by their range.
        points: count of indices.
    """
    count = len(values)
    if count <= points:
        return np.arange(count)
    table = np.asarray(values, float).reshape(count, -1)
    low, high = (
        np.where(np.isfinite(table), table, np.inf),
        np.where(np.isfinite(table), table, -np.inf),
    )
    buckets = max(1, points // (2 * table.shape[1]))
    edges = np.linspace(0, count, buckets + 1).astype(int)
    keep = {0, count - 1}
    for start, stop in pairwise(edges):
        if stop > start:
            keep.update(start + low[start:stop].argmin(axis=0))
            keep.update(start + high[start:stop].argmax(axis=0))
    return np.array(sorted(keep))


@dataclass(frozen=True)
class Chosen:
    """A run that is drawn, and the reason."""

    run: int
    why: str


def choose_runs(entries: Sequence[Entry], most: int) -> list[Chosen]:
    """Runs to draw: the worst, best and median by NEES/n of each entry, then the first ones."""
    reasons: dict[int, dict[str, list[str]]] = {}
    ranked = []
    for entry in entries:
        anees = np.where(np.isfinite(entry.record["anees"]), entry.record["anees"], np.inf)
        order = np.argsort(anees, kind="stable")
        ranked.append((entry.key, entry.source.runs[order]))
    for what, place in (("worst", -1), ("best", 0), ("median", None)):
        for key, runs in ranked:
            index = (len(runs) - 1) // 2 if place is None else place
            reasons.setdefault(int(runs[index]), {}).setdefault(what, []).append(key)
    for run in entries[0].source.runs[:most]:
        reasons.setdefault(int(run), {})
    chosen = []
    for run, why in list(reasons.items())[:most]:
        parts = (
            what if len(keys) == len(entries) else f"{what} of {', '.join(keys)}"
            for what, keys in why.items()
        )
        chosen.append(Chosen(run, "; ".join(parts)))
    return sorted(chosen, key=lambda c: c.run)
