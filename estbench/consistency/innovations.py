"""The verdict of the innovations alone, where no truth is known: one run is divided into parts.

The innovations of a consistent filter have the covariance S, mean 0, and no correlation in time.
The averages over parts of the time that are long against their correlation are independent (batch
means; Law 2015, Simulation Modeling and Analysis, sec. 9.5.3), and take the place of runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.consistency.fields import Record
from estbench.consistency.hypotheses import Kind, family
from estbench.consistency.intervals import Interval, positive_mean_interval
from estbench.consistency.verdict import Judgement, Verdict, is_refuted, is_shown, word
from estbench.inference.lags import LAGS, correlation
from estbench.shapes import Array, Float, Int, Ints

BLOCKS = 20
"""Parts into which the updates of a run are divided."""
FEWEST = 10
"""Updates of a part."""
NEEDED = ("anis", "channel_nis", "scaled_innovation", "lags", "lag_terms")
"""Variables of a judgement of the innovations alone."""


@dataclass(frozen=True, eq=False)
class InnovationSeries:
    """The innovations of one run, update by update.

    Attributes:
        nis: NIS, not divided by m.
        dof: m of each update.
        channel_nis: NIS/m of each channel, given those before it; NaN where it did not arrive.
        scaled: ν/√S of each component; NaN where it did not arrive.
    """

    nis: Float[Array, " update"]
    dof: Int[Ints, " update"]
    channel_nis: Float[Array, "update channel"]
    scaled: Float[Array, "update m"]


@dataclass(frozen=True)
class InnovationVerdict:
    """What the innovations of one run say.

    Attributes:
        verdict: the word.
        nis: NIS/m with its interval.
        channels: the same of each channel.
        bias: mean ν/√S of each component.
        lag_one: correlation of ν/√S from one arrival to the next, of all components.
        reason: the hypothesis that is refuted most; empty where none is.
        blocks: parts of the run that give the intervals.
    """

    verdict: Verdict
    nis: Interval
    channels: tuple[Interval, ...]
    bias: tuple[float, ...]
    lag_one: float
    reason: str
    blocks: int


def judge_innovations(
    series: InnovationSeries,
    channels: Sequence[str],
    components: Sequence[str],
    failed: bool = False,
    level: float = 0.95,
    tolerance: float = 0.1,
) -> InnovationVerdict:
    """The verdict from the innovations of one run.

    The hypotheses about innovations of `consistency.hypotheses`, each with parts for runs, and
    that the mean of ν/√S of each component is 0; refuted and shown as in `verdict.judge`.

    Args:
        series: of the updates that count.
        channels: their names.
        components: names of the components of a reading.
        failed: whether the estimator failed.
        level: confidence.
        tolerance: a difference of NIS/m from 1 that does not matter.
    """
    record = by_part(series, parts(np.arange(len(series.nis))))
    judged = judge(record, failed, level, tolerance)
    sums, terms = record["lags"].sum(axis=0), record["lag_terms"].sum(axis=0)
    return InnovationVerdict(
        verdict=judged.verdict,
        nis=positive_mean_interval(record["anis"], level),
        channels=tuple(positive_mean_interval(c, level) for c in record["channel_nis"].T),
        bias=tuple(float(b) for b in _mean(series.scaled)),
        lag_one=float(correlation(sums, terms)[1]),
        reason=reason(judged, channels, components),
        blocks=len(record["anis"]),
    )


def judge(
    record: Record, failed: bool = False, level: float = 0.95, tolerance: float = 0.1
) -> Judgement:
    """The judgement of the innovations of one run.

    Args:
        record: of `by_part`.
        failed: whether the estimator failed.
        level: confidence.
        tolerance: a difference of NIS/m from 1 that does not matter.
    """
    record = {name: record[name] for name in NEEDED}
    count = len(record["anis"])
    hypotheses = family(record, np.ones(count, bool), level)
    refuted = tuple(h for h in hypotheses if is_refuted(h, level, tolerance))
    unshown = tuple(h for h in hypotheses if h not in refuted and not is_shown(h, tolerance))
    return Judgement(
        verdict=word(refuted, unshown, count, float(failed)), hypotheses=hypotheses,
        refuted=refuted, open=unshown, needed=None, runs=count, lost=count if failed else 0,
        failed=0, failed_step=-1, copies=0, lacking=(),
    )  # fmt: skip


def parts(updates: Int[Ints, " update"], most: int = BLOCKS) -> list[Int[Ints, " _"]]:
    """The updates of a run in parts that follow each other, at most so many."""
    return np.array_split(updates, max(1, min(most, BLOCKS, len(updates) // FEWEST)))


def by_part(series: InnovationSeries, parts: Sequence[Ints]) -> Record:
    """The variables of the hypotheses, parts in place of runs.

    Args:
        series: of the updates that count.
        parts: indices of the updates of each part.
    """
    ratio = series.nis / np.maximum(series.dof, 1)
    lags = [_lags(series.scaled, part) for part in parts]
    return {
        "anis": np.array([ratio[part].mean() if len(part) else np.nan for part in parts]),
        "channel_nis": np.stack([_mean(series.channel_nis[part]) for part in parts]),
        "scaled_innovation": np.stack([_mean(series.scaled[part]) for part in parts]),
        "lags": np.stack([sums for sums, _ in lags]),
        "lag_terms": np.stack([terms for _, terms in lags]),
    }


def _mean(values: Float[Array, "k m"]) -> Float[Array, " m"]:
    """Mean of the values that there are; NaN for none."""
    known = np.isfinite(values)
    number = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _lags(
    scaled: Float[Array, "update m"], part: Ints
) -> tuple[Float[Array, " lag"], Int[Ints, " lag"]]:
    """Sums of zₖ zₖ₋ₗ over the arrivals of each component in a block, and their counts."""
    sums, terms = np.zeros(LAGS + 1), np.zeros(LAGS + 1, np.int64)
    for column in scaled[part].T:
        z = column[np.isfinite(column)]
        for lag in range(min(LAGS + 1, len(z))):
            sums[lag] += z[lag:] @ z[: len(z) - lag]
            terms[lag] += len(z) - lag
    return sums, terms


def reason(judged: Judgement, channels: Sequence[str], components: Sequence[str]) -> str:
    """The hypothesis with the least p-value, in words; empty where none is refuted.

    Args:
        judged: of `judge`.
        channels: their names.
        components: names of the components of the readings.
    """
    refuted = judged.refuted
    if not refuted:
        return ""
    worst = min(refuted, key=lambda h: (h.adjusted, -abs(h.mean.value - h.ideal)))
    what = {
        Kind.NIS: "NIS/m",
        Kind.CHANNEL: f"NIS/m of {_name(channels, worst.channel)}",
        Kind.WHITENESS: f"correlation of the innovations at lag {worst.place}",
    }.get(worst.kind, f"mean innovation of {_name(components, worst.coordinate)} over its σ")
    mean = worst.mean
    others = len({(h.kind, h.channel, h.coordinate) for h in refuted}) - 1
    more = f", and {others} more" if others else ""
    interval = f"{mean.value:.3g} [{mean.low:.3g}, {mean.high:.3g}]"
    return f"{what} is {interval}, not {worst.ideal:g}{more}"


def _name(names: Sequence[str], index: int | None) -> str:
    return names[index or 0]
