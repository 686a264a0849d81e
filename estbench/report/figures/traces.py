"""Statistics of the traces of all runs, read batch by batch so that large stores fit."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import stats

from estbench.consistency.intervals import normal_quantile
from estbench.consistency.nees import chi_square_band
from estbench.montecarlo.executors import cpu_count
from estbench.report.figures.data import thin
from estbench.report.sources import Entry
from estbench.shapes import Array

LAGS = 40
ERROR_EDGES = np.linspace(-5.0, 5.0, 81)
"""Bins of error/σ."""
NEES_BINS = 60


@dataclass(frozen=True, eq=False)
class TraceStatistics:
    """Statistics of one estimator's traces, over the runs that did not diverge.

    Attributes:
        errors: density of error/σ in the bins `ERROR_EDGES` `(n, bins)`.
        beyond: share of error/σ outside these bins `(n,)`.
        nees_edges, nees: bins of NEES and the density in them.
        ranks: share of the values of NEES with 0, 1, ..., n degrees of freedom `(n + 1,)`.
        outside: share of single values of NEES and NIS outside the band of one run.
        correlation: autocorrelation of NIS by lag in instants `(LAGS + 1,)`; NaN without pairs.
        correlation_band: half-width of the band of each lag for independent innovations.
        fourth: sum over runs of the fourth power of the error `(K + 1, n)`.
        left: start of the time above the threshold for which each diverged run counts as diverged,
            s, by run number; NaN if it failed without.
    """

    errors: Array
    beyond: Array
    nees_edges: Array
    nees: Array
    ranks: Array
    outside: tuple[float, float]
    correlation: Array
    correlation_band: Array
    fourth: Array
    left: dict[int, float]


@dataclass(frozen=True, eq=False)
class _Part:
    """The sums of one batch."""

    errors: Array
    inexact: Array
    nees: Array
    ranks: Array
    out: Array
    products: Array
    pairs: Array
    fourth: Array
    left: dict[int, float]


def statistics(entry: Entry) -> TraceStatistics | None:
    """The statistics of an entry's traces, or None if the store has none."""
    if not entry.source.has_traces:
        return None
    source, n = entry.source, entry.source.n
    edges = np.linspace(0.0, float(stats.chi2.ppf(0.9999, n)), NEES_BINS + 1)
    with ThreadPoolExecutor(cpu_count()) as pool:
        parts = list(pool.map(lambda piece: _part(entry, piece[0], piece[1], edges), pieces(entry)))
    errors, inexact, nees, ranks, out, products, pairs, fourth = (
        np.sum([getattr(p, name) for p in parts], axis=0)
        for name in (
            "errors", "inexact", "nees", "ranks", "out", "products", "pairs", "fourth"
        )
    )  # fmt: skip
    total, inexact = ranks.sum(), np.maximum(inexact, 1)
    left: dict[int, float] = {}
    for part in parts:
        left |= part.left
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(pairs > 0, products / pairs, np.nan)
        z = normal_quantile(source.level)
        return TraceStatistics(
            errors=errors / (inexact[:, None] * np.diff(ERROR_EDGES)),
            beyond=1 - errors.sum(axis=1) / inexact,
            nees_edges=edges,
            nees=nees / (total * np.diff(edges)),
            ranks=ranks / total,
            outside=(float(out[0] / out[1]), float(out[2] / out[3]) if out[3] else np.nan),
            correlation=mean / mean[0],
            correlation_band=z / np.sqrt(pairs),
            fourth=fourth,
            left=left,
        )


def pieces(entry: Entry) -> Iterator[tuple[slice, slice]]:
    """Each finished batch as indices in the store and in the record."""
    start = 0
    for where in entry.source.batches:
        stop = start + where.stop - where.start
        yield where, slice(start, stop)
        start = stop


def _part(entry: Entry, where: slice, rows: slice, edges: Array) -> _Part:
    source, n = entry.source, entry.source.n
    group = entry.group.isel(run=where)
    good = entry.good[rows]
    nees, rank = _double(group, "nees"), source.rank(group)
    left = _left(entry, nees[~good] / np.maximum(rank[~good], 1), source.runs[rows][~good])
    nees, rank = nees[good], rank[good]
    error, std = _double(group, "error")[good], _double(group, "std")[good]
    settled = source.settled
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(std == 0, np.nan, error / std)[:, settled]
    errors = np.stack([_histogram(ratio[..., i], ERROR_EDGES) for i in range(n)])
    nis, dof = _double(group, "nis")[good], group["dof"].values[good]
    out = np.concatenate(
        [
            _outside(nees[:, settled], rank[:, settled], source.level),
            _outside(nis[:, settled], dof[:, settled], source.level),
        ]
    )
    products, pairs = _products(nis[:, settled], dof[:, settled])
    return _Part(
        errors, np.count_nonzero(std[:, settled] != 0, axis=(0, 1)),
        _histogram(nees[:, settled], edges),
        np.bincount(rank[:, settled].ravel(), minlength=n + 1).astype(np.float64),
        out, products, pairs, (error**4).sum(axis=0), left,
    )  # fmt: skip


def _histogram(values: Array, edges: Array) -> Array:
    """Counts in bins of equal width, for which numpy has a faster method."""
    return np.histogram(values, len(edges) - 1, (edges[0], edges[-1]))[0]


def _double(group: xr.Dataset, name: str) -> Array:
    """A trace in double precision; the store may have float32."""
    return group[name].values.astype(np.float64)


def _outside(values: Array, dof: NDArray, level: float) -> Array:
    """Count of the values outside the chi-square band of one run, and count of all values."""
    sizes = np.unique(dof[dof > 0])
    low, high = np.zeros(int(dof.max(initial=0)) + 1), np.zeros(int(dof.max(initial=0)) + 1)
    for m in sizes:
        low[m], high[m] = chi_square_band(float(m), 1, level)
    used = np.broadcast_to(dof > 0, values.shape) & np.isfinite(values)
    with np.errstate(invalid="ignore"):
        out = used & ((values < low[dof]) | (values > high[dof]))
    return np.array([out.sum(), used.sum()], float)


def _products(nis: Array, dof: NDArray) -> tuple[Array, Array]:
    """Sums over runs and instants of z(k) z(k + lag), and their counts; z = (NIS - m)/sqrt(2 m).

    NIS of a consistent filter is independent from one update to the next, of mean m and variance
    2 m. Lags count instants; a product exists if readings arrived at both.
    """
    used = dof > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.where(used, (nis - dof) / np.sqrt(2.0 * dof), 0.0)
    z = np.where(np.isfinite(z), z, 0.0)
    return _lagged(z), np.rint(_lagged(used.astype(float)))


def _lagged(values: Array) -> Array:
    """Sums over rows and columns k of v(k) v(k + lag), by the power spectrum `(LAGS + 1,)`."""
    steps = values.shape[1]
    size = 1 << (2 * steps - 1).bit_length()  # padded with zeros against wrap-around
    power = (np.abs(np.fft.rfft(values, size, axis=1)) ** 2).sum(axis=0)
    out = np.zeros(LAGS + 1)
    lags = min(LAGS + 1, steps)
    out[:lags] = np.fft.irfft(power, size)[:lags]
    return out


def _left(entry: Entry, ratio: Array, runs: NDArray[np.int64]) -> dict[int, float]:
    """Start of the time of NEES/n above the threshold for which each run counts as diverged, s."""
    section, times = entry.source.scenario.consistency, entry.source.times
    window = max(1, min(round(section.divergence_duration / np.diff(times).mean()), len(times)))
    found = {}
    for run, row in zip(runs, ratio):
        with np.errstate(invalid="ignore"):
            above = row > section.divergence_threshold
        total = np.concatenate([[0], above.cumsum()])
        full = np.flatnonzero(total[window:] - total[:-window] == window)
        found[int(run)] = float(times[full[0]]) if len(full) else np.nan
    return found


@dataclass(frozen=True, eq=False)
class RunTrace:
    """One run of one estimator, thinned for drawing.

    Attributes:
        time: `(k,)` s.
        error, std: `(n, k)`, in the coordinates' units.
        nees: NEES/n `(k,)`.
    """

    time: Array
    error: Array
    std: Array
    nees: Array


def run_trace(entry: Entry, run: int, points: int) -> RunTrace | None:
    """The trace of a run, or None if the store does not have it.

    Each bucket of instants keeps those with the greatest |error|/σ of any coordinate.
    """
    place = entry.position(run)
    if place is None or not entry.source.has_traces:
        return None
    group = entry.group.isel(run=place)
    error, std, nees = (group[name].values for name in ("error", "std", "nees"))
    ratio = nees / np.maximum(entry.source.rank(group), 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        worst = np.nanmax(np.where(np.isfinite(error / std), np.abs(error / std), -1.0), axis=1)
    keep = thin(worst, points)
    return RunTrace(entry.source.times[keep], error[keep].T, std[keep].T, ratio[keep])


def run_points(entries: Sequence[Entry], budget: int = 400_000) -> tuple[int, int]:
    """Count of runs and instants in a page: `runs x entries x 2 n x instants <= budget`."""
    width = sum(2 * entry.source.n + 2 for entry in entries)
    steps = min(500, max(len(entry.source.times) for entry in entries))
    runs = int(np.clip(budget // (width * steps), 4, 16))
    return runs, int(np.clip(budget // (width * runs), 100, steps))
