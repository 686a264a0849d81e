"""Autocorrelation of the whitened innovations of a store, together and by channel."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estbench.consistency.intervals import normal_quantile
from estbench.consistency.whiteness import Whiteness, whiteness
from estbench.errors import EstbenchError
from estbench.experiment import setup
from estbench.inference.lags import Lags
from estbench.report.sources import Entry
from estbench.shapes import Array
from estbench.spaces.linalg import cholesky, solve_lower


@dataclass(frozen=True, eq=False)
class Correlation:
    """Autocorrelation of whitened innovations, over the runs that did not diverge.

    Attributes:
        found: correlation of each lag from 1, and Ljung & Box's test.
        band: half-width, per lag, of the band of the mean correlation of white innovations.
    """

    found: Whiteness
    band: Array


def whole(entry: Entry) -> Correlation | None:
    """Correlation of all channels together, or None if the store has no lag products."""
    if "lags" not in entry.record:
        return None
    good = ~entry.sample["diverged"].astype(bool)
    return _correlation(entry, entry.sample["lags"][good], entry.sample["lag_terms"][good])


def by_channel(entry: Entry) -> dict[str, Correlation]:
    """Correlation of each channel, whitened by its own block of S.

    {} if the store does not have the innovations, or the robot's file is missing.
    """
    if "innovation" not in entry.group:
        return {}
    try:
        spaces = setup.build(entry.source.scenario).channel_spaces
    except EstbenchError:
        return {}
    out, start = {}, 0
    for channel, space in spaces.items():
        columns = list(range(start, start + space.n))
        start += space.n
        sums, terms = zip(*_products(entry, columns), strict=True)
        good = entry.good
        found = _correlation(entry, np.concatenate(sums)[good], np.concatenate(terms)[good])
        if found is not None:
            out[channel] = found
    return out


def _products(entry: Entry, columns: list[int]) -> Iterator[tuple[Array, NDArray[np.int64]]]:
    """Lag products of the given components of the innovation, batch by batch."""
    for where in entry.source.batches:
        group = entry.group.isel(run=where)
        residual = group["innovation"].values[..., columns].astype(np.float64)
        cov = group["innovation_cov"].values[..., columns, :][..., columns].astype(np.float64)
        runs, steps, m = residual.shape
        factor = cholesky(np.where(np.isfinite(cov), cov, 0.0).reshape(-1, m, m))
        white = solve_lower(factor, residual.reshape(-1, m, 1)).reshape(runs, steps, m)
        came = np.isfinite(white).all(axis=-1)
        white = np.where(came[..., None], white, 0.0)
        lags = Lags(runs, {"channel": m})
        for k in np.flatnonzero(came.any(axis=0)):
            mask = np.repeat(came[:, k, None], m, axis=1)
            lags.put(int(k), 0, ["channel"], white[:, k], mask)
        yield lags.sums()


def _correlation(entry: Entry, sums: Array, terms: NDArray[np.int64]) -> Correlation | None:
    found = whiteness(sums, terms, entry.source.level)
    if found is None:
        return None
    used = np.isfinite(sums).all(axis=-1) & (terms[:, 1:] > 0).any(axis=-1)
    z = normal_quantile(entry.source.level)
    with np.errstate(divide="ignore"):  # a lag longer than all runs
        spread = np.sqrt((1 / terms[used, 1:]).sum(axis=0)) / used.sum()
    return Correlation(found, z * spread)
