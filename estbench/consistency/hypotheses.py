"""The hypotheses of a consistent filter, as one family with one false-alarm rate.

The errors are as large as the covariance says and have mean 0; the innovations are as large as S
says and white. Each is a statement about the mean over runs of one number per run, as the runs are
independent and the steps of a run are not.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import scipy  # imports its statistics at their first use; a worker has none

from estbench.consistency.fields import Record
from estbench.consistency.intervals import Interval, positive_mean_bounds, student_quantile
from estbench.consistency.multiplicity import holm
from estbench.inference.lags import LAGS, correlation
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask

SPREAD = 0.02
"""Spread over the runs of log σ² above which runs are told apart by their covariance."""
FEWEST = 10
"""Runs from which on they are told apart so."""


class Kind(StrEnum):
    """What a hypothesis is about, by the variable's meaning."""

    NEES = "NEES/n"
    NEES_BLOCK = "NEES/n in a block of time"
    NEES_SIZE = "NEES/n where the covariance is small or large"
    NEES_RUNS = "NEES/n of the runs with a small or large covariance"
    NEES_ALONG = "NEES/n along combinations of coordinates"
    NEES_PHASE = "NEES/n in a phase of contact"
    COORDINATE = "squared error of a coordinate over its variance"
    COORDINATE_SIZE = "squared error of a coordinate over its variance where this is small or large"
    COORDINATE_BLOCK = "squared error of a coordinate over its variance in a block of time"
    BIAS = "mean error of a coordinate over σ"
    BIAS_BLOCK = "mean error of a coordinate over σ in a block of time"
    NIS = "NIS/m"
    NIS_BLOCK = "NIS/m in a block of time"
    CHANNEL = "NIS/m of a channel"
    WHITENESS = "correlation of the innovations"
    INNOVATION = "mean innovation of a component over its σ"


WEIGHTS = {
    Kind.NEES: 0.2, Kind.NIS: 0.1, Kind.COORDINATE: 0.1, Kind.BIAS: 0.125,
    Kind.NEES_BLOCK: 0.075, Kind.COORDINATE_BLOCK: 0.05, Kind.BIAS_BLOCK: 0.05,
    Kind.NEES_SIZE: 0.05, Kind.NEES_RUNS: 0.05, Kind.CHANNEL: 0.05, Kind.WHITENESS: 0.05,
    Kind.NEES_ALONG: 0.05, Kind.COORDINATE_SIZE: 0.025, Kind.NIS_BLOCK: 0.025,
    Kind.NEES_PHASE: 0.05, Kind.INNOVATION: 0.175,
}  # fmt: skip
"""Share of the false-alarm rate that the hypotheses of a kind have together, relative to the others
that there are."""
CHOSEN = 1.5
"""Factor by which the mean NEES/n of a consistent filter may differ from 1 in a phase of contact.
The true state says when the phase is, so that the errors of its instants are chosen with them; up
to 1.23 is found for Kalman filters (docs/statistics.md)."""
BIASES = (Kind.BIAS, Kind.BIAS_BLOCK, Kind.INNOVATION)
VARIABLES = {
    Kind.NEES: ("anees",),
    Kind.NEES_BLOCK: ("nees_by_block",),
    Kind.NEES_SIZE: ("nees_by_size",),
    Kind.NEES_RUNS: ("anees", "variance"),
    Kind.NEES_ALONG: ("nees_along",),
    Kind.NEES_PHASE: ("anees_by_phase", "phase_steps"),
    Kind.COORDINATE: ("scaled_square",),
    Kind.COORDINATE_SIZE: ("scaled_square_by_size",),
    Kind.COORDINATE_BLOCK: ("scaled_square",),
    Kind.BIAS: ("scaled_error",),
    Kind.BIAS_BLOCK: ("scaled_error",),
    Kind.NIS: ("anis",),
    Kind.NIS_BLOCK: ("nis_by_block",),
    Kind.CHANNEL: ("channel_nis",),
    Kind.WHITENESS: ("lags", "lag_terms"),
    Kind.INNOVATION: ("scaled_innovation",),
}
"""The variables that each kind needs; a store of an earlier version may lack them."""


@dataclass(frozen=True)
class Hypothesis:
    """One hypothesis and its test.

    Attributes:
        kind: what it is about.
        mean: over the runs, with its interval at the level, not corrected for the other hypotheses.
        spread: standard deviation across runs.
        runs: that have a value.
        p: two-sided p-value of the ideal value.
        adjusted: by Holm over the whole family.
        ideal: 1 for a ratio, 0 for a mean error or a correlation.
        coordinate, block, channel: indices of what it is about, or None; the coordinate of
            `INNOVATION` is a component of the readings.
        place: of `NEES_SIZE`, `COORDINATE_SIZE` and `NEES_RUNS` 0 for small covariances and 1 for
            large ones, of `WHITENESS` the lag, of `NEES_PHASE` that of `fields.PHASES`, of
            `NEES_ALONG` that of `spaces.directions`; else 0.
    """

    kind: Kind
    mean: Interval
    spread: float
    runs: int
    p: float
    adjusted: float
    ideal: float
    coordinate: int | None = None
    block: int | None = None
    channel: int | None = None
    place: int = 0


@dataclass(frozen=True, eq=False)
class _Tests:
    """The tests of several columns."""

    mean: Float[Array, " k"]
    low: Float[Array, " k"]
    high: Float[Array, " k"]
    spread: Float[Array, " k"]
    runs: Float[Array, " k"]
    p: Float[Array, " k"]


def family(record: Record, good: Bool[Mask, " run"], level: float) -> tuple[Hypothesis, ...]:
    """All hypotheses that the record has the variables for, tested over some runs.

    Args:
        record: as `records.merge` gives it.
        good: the runs that count.
        level: of the intervals.
    """
    found: list[tuple[Kind, tuple[int, ...], _Tests]] = []
    for kind, variables in VARIABLES.items():
        if all(name in record for name in variables):
            values = _values(kind, record, good)
            shape, columns = (
                values.shape[1:],
                values.reshape(len(values), math.prod(values.shape[1:])),
            )
            slack = CHOSEN if kind is Kind.NEES_PHASE else 1.0
            found.append((kind, shape, _tested(columns, level, _ideal(kind), slack)))
    p = np.concatenate([tests.p for *_, tests in found])
    weights = np.concatenate(
        [
            np.full(len(tests.p), WEIGHTS[kind] / max(1, np.isfinite(tests.p).sum()))
            for kind, _, tests in found
        ]
    )
    known = np.isfinite(p)
    adjusted = np.full(len(p), np.nan)
    adjusted[known] = holm(p[known], weights[known])
    return tuple(_listed(found, adjusted))


def _ideal(kind: Kind) -> float:
    return 0.0 if kind in (*BIASES, Kind.WHITENESS) else 1.0


def _listed(
    found: list[tuple[Kind, tuple[int, ...], _Tests]], adjusted: Float[Array, " k"]
) -> Iterator[Hypothesis]:
    """The hypotheses whose p-value is known."""
    start = 0
    for kind, shape, t in found:
        for i in range(len(t.p)):
            if np.isfinite(t.p[i]):
                yield Hypothesis(
                    kind, Interval(float(t.mean[i]), float(t.low[i]), float(t.high[i])),
                    float(t.spread[i]), int(t.runs[i]), float(t.p[i]), float(adjusted[start + i]),
                    _ideal(kind), **_place(kind, np.unravel_index(i, shape) if shape else ()),
                )  # fmt: skip
        start += len(t.p)


def _place(kind: Kind, index: tuple[np.intp, ...]) -> dict[str, int]:
    """What a column is about."""
    where = [int(i) for i in index]
    match kind:
        case Kind.NEES_BLOCK | Kind.NIS_BLOCK:
            return {"block": where[0]}
        case Kind.COORDINATE | Kind.BIAS | Kind.INNOVATION:
            return {"coordinate": where[0]}
        case Kind.COORDINATE_BLOCK | Kind.BIAS_BLOCK:
            return {"block": where[0], "coordinate": where[1]}
        case Kind.CHANNEL:
            return {"channel": where[0]}
        case Kind.COORDINATE_SIZE:
            return {"place": where[0], "coordinate": where[1]}
        case Kind.NEES_SIZE | Kind.NEES_RUNS | Kind.NEES_ALONG | Kind.NEES_PHASE:
            return {"place": where[0]}
        case Kind.WHITENESS:
            return {"place": where[0] + 1}
        case _:
            return {}


def _values(kind: Kind, record: Record, good: Bool[Mask, " run"]) -> Float[Array, "good ..."]:
    """One number per run of each hypothesis; NaN where a run has none."""
    match kind:
        case Kind.NEES_RUNS:
            return _by_covariance(record["anees"][good], record["variance"][good])
        case Kind.NEES_PHASE:
            return _in_phases(record["anees_by_phase"][good], record["phase_steps"])
        case Kind.COORDINATE | Kind.BIAS:
            blocks = record[VARIABLES[kind][0]][good]
            known = np.isfinite(blocks)
            number = known.sum(axis=1)
            total = np.where(known, blocks, 0.0).sum(axis=1)
            return np.where(number > 0, total / np.maximum(number, 1), np.nan)
        case Kind.WHITENESS:
            return correlation(record["lags"][good], record["lag_terms"][good])[:, 1 : 1 + LAGS]
        case _:
            return np.asarray(record[VARIABLES[kind][0]][good], np.float64)


def _by_covariance(
    anees: Float[Array, " run"], variance: Float[Array, "run n"]
) -> Float[Array, "run 2"]:
    """NEES/n in the column of runs with a covariance below the median, or in that of the others.

    The size of a covariance is the mean over the coordinates of log σ². Where the runs hardly
    differ (a linear filter has the same P in all of them) no run is in a column.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.where(variance > 0, np.log(variance), 0.0).mean(axis=-1)
    out = np.full((len(anees), 2), np.nan)
    if len(anees) >= FEWEST and np.isfinite(size).all() and size.std() > SPREAD:
        small = size < np.median(size)
        out[small, 0], out[~small, 1] = anees[small], anees[~small]
    return out


def _in_phases(
    anees: Float[Array, "good phase"], steps: Int[Ints, "run phase"]
) -> Float[Array, "good phase"]:
    """NEES/n in each phase; NaN where all instants are of one phase, which is the whole run."""
    return anees if np.count_nonzero(steps.sum(axis=0)) > 1 else np.full_like(anees, np.nan)


def _tested(
    values: Float[Array, "run k"], level: float, ideal: float, slack: float = 1.0
) -> _Tests:
    """Mean, interval and p-value of each column, over its finite values.

    Ratios are positive and skewed: their mean is tested as in `positive_mean_bounds`, mean errors
    and correlations by Student's t.

    Args:
        values: of each run.
        level: of the intervals.
        ideal: 1 for ratios, 0 for mean errors and correlations.
        slack: of a ratio; the hypothesis is that the mean is from 1/slack to slack.
    """
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    enough = count >= 2
    n = np.where(enough, count, 2).astype(float)
    mean = np.where(finite, values, 0.0).sum(axis=0) / n
    square = (np.where(finite, values - mean, 0.0) ** 2).sum(axis=0) / (n - 1)
    fixed = square <= 1e-24 * mean**2  # all runs have the same value
    with np.errstate(invalid="ignore", divide="ignore"):
        if ideal:
            low, high = positive_mean_bounds(mean, square, n, level)
            relative = square / mean**2
            v = relative / n / 9
            off = mean / np.clip(mean, 1 / slack, slack) if slack > 1 else mean
            t, dof = (np.cbrt(off) - (1 - v)) / np.sqrt(v), (n - 1) / (1 + relative)
            t = np.where((off == 1) & (slack > 1), 0.0, t)
        else:
            half = student_quantile(level, n - 1) * np.sqrt(square / n)
            low, high = mean - half, mean + half
            t, dof = mean / np.sqrt(square / n), n - 1
        p = 2 * scipy.stats.t.sf(np.abs(t), dof)
    away = np.abs(mean - ideal) if slack == 1 else np.abs(np.log(np.maximum(mean, 1e-300)))
    p = np.where(fixed, np.where(away > max(1e-9, np.log(slack)), 0.0, 1.0), p)
    low, high = np.where(fixed, mean, low), np.where(fixed, mean, high)
    p = np.where(enough, p, np.nan)
    return _Tests(mean, low, high, np.sqrt(square), count.astype(float), p)
