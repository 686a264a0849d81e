"""The score of an estimator in each run, by which two estimators are compared on the same runs."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estbench.consistency.fields import Record
from estbench.consistency.intervals import Interval, mean_interval
from estbench.shapes import Array

TINY = 1e-300
"""Least squared error, so that the logarithm is finite."""


def score(mse: Array, lost: NDArray[np.bool_]) -> Array:
    """The mean over the coordinates of log RMSE, one number per run `(run,)`.

    Leave out coordinates that an estimator knows exactly: their errors are rounding errors.

    The exponential of a difference is the geometric mean over the coordinates of the ratios of
    RMSE. It has no unit and needs no weights; the size of a coordinate has no influence.

    Args:
        mse: mean squared error `(run, coordinate)`.
        lost: whether the run diverged `(run,)`; its score is infinite.
    """
    with np.errstate(invalid="ignore"):
        return np.where(lost, np.inf, 0.5 * np.log(np.maximum(mse, TINY)).mean(axis=1))


def difference(a: Array, b: Array, level: float = 0.95) -> Interval:
    """Mean of a - b over the runs lost by neither, with Student's t interval."""
    both = np.isfinite(a) & np.isfinite(b)
    return mean_interval(a[both] - b[both], level)


def inexact(records: Sequence[Record]) -> NDArray[np.intp]:
    """Coordinates that no estimator knows exactly at every step; all where every one is known.

    Args:
        records: of the estimators that are compared.
    """
    known: NDArray[np.bool_] = np.max([_always_known(r) for r in records], axis=0)
    return np.flatnonzero(~known | known.all())


def _always_known(record: Record) -> NDArray[np.bool_]:
    """Coordinates `(n,)` that the estimator knows exactly at every step; none of older stores."""
    n = record["mse"].shape[1]
    return (record["known"] == 1).all(axis=0) if "known" in record else np.zeros(n, bool)
