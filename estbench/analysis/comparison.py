"""Estimators compared in pairs on common random numbers, and ranked with their ties.

Run i has one truth and one set of measurements whatever looks at it, so two estimators are compared
run by run: what a run's luck does to both cancels. A value that is not finite stands for a run that
was lost; it is worse than every other, and as bad as another lost run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from estbench.consistency.intervals import Interval, mean_interval
from estbench.shapes import Array

ROUNDING = 1e-9
"""Differences below this part of the values are of rounding, and count as none."""
TINY = 1e-300
"""Stands for a squared error of zero, so that its logarithm is finite."""


@dataclass(frozen=True)
class Paired:
    """One estimator minus another, over the runs that both have.

    Attributes:
        runs: how many neither lost; the difference is over these.
        difference: mean of a - b with Student's t interval.
        lost: share of the runs that a lost, less the share that b did.
        less, more, ties: runs, lost ones included, in which a is below, above, as b.
        effect: (W₊ - W₋)/(W₊ + W₋) of the signed ranks, in [-1, 1]: below 0 where a is less.
        sign: two-sided p-value of the exact sign test: is a below b as often as above?
        wilcoxon: of Wilcoxon's signed-rank test: is a - b symmetric about 0? It is under the
            hypothesis that the two are exchangeable.
    """

    runs: int
    difference: Interval
    lost: float
    less: int
    more: int
    ties: int
    effect: float
    sign: float
    wilcoxon: float


def paired(a: Array, b: Array, level: float = 0.95, scale: float | None = None) -> Paired:
    """Compare two estimators by one value a run each, smaller is better.

    Args:
        a: value of each run `(run,)`, e.g. its RMSE; not finite where it was lost.
        b: the same runs' values of the other estimator `(run,)`.
        level: confidence of the interval.
        scale: size of the values, by which differences of rounding are known; default their
            median size.
    """
    a, b = (np.where(np.isfinite(x), x, np.inf) for x in (a, b))
    both = np.isfinite(a) & np.isfinite(b)
    if scale is None:
        scale = float(np.median(np.abs(np.concatenate([a[both], b[both]])))) if both.any() else 0.0
    exact = a[both] - b[both]
    difference = np.where(np.abs(exact) <= ROUNDING * scale, 0.0, exact)
    # A lost run's difference is infinite; for its rank it is enough that it is the largest.
    largest = 2 * float(np.abs(difference).max(initial=1.0))
    signed = np.zeros(len(a))
    signed[both] = difference
    signed[np.isinf(a) & np.isfinite(b)] = largest
    signed[np.isfinite(a) & np.isinf(b)] = -largest
    less, more = int((signed < 0).sum()), int((signed > 0).sum())
    moved = signed[signed != 0]
    ranks = stats.rankdata(np.abs(moved))
    return Paired(
        runs=int(both.sum()),
        difference=mean_interval(exact, level),
        lost=float(np.mean(np.isinf(a)) - np.mean(np.isinf(b))),
        less=less,
        more=more,
        ties=len(a) - less - more,
        effect=float(np.sign(moved) @ ranks / ranks.sum()) if len(moved) else 0.0,
        sign=float(stats.binomtest(less, less + more).pvalue) if less + more else 1.0,
        wilcoxon=float(stats.wilcoxon(signed).pvalue) if less + more else 1.0,
    )


def holm(p: Sequence[float]) -> Array:
    """Holm's adjusted p-values `(k,)`: below α, the chance of any false alarm of all k is below α.

    The i-th smallest is multiplied by k - i + 1 and made monotone (Holm 1979, Scand. J. Stat. 6).
    """
    values = np.asarray(p, float)
    order = np.argsort(values, kind="stable")
    steps = values[order] * np.arange(len(values), 0, -1)
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


@dataclass(frozen=True)
class Pair:
    """Two estimators' comparison, and its p-values adjusted for all the pairs there are.

    Attributes:
        a, b: keys.
        paired: of the scores, a - b; these are logarithms.
        ratio: exp of the difference: a's error over b's.
        sign, wilcoxon: adjusted by Holm.
        differ: whether they are told apart, and by more than the margin.
    """

    a: str
    b: str
    paired: Paired
    ratio: Interval
    sign: float
    wilcoxon: float
    differ: bool


@dataclass(frozen=True)
class Rank:
    """An estimator's place.

    Attributes:
        key: the estimator.
        place: 1 + how many are better; all differences are significant after Holm.
        last: how many there are less how many are worse: its rank is in [place, last], for all
            estimators at once at the level asked for (Mogstad et al. 2024, Rev. Econ. Stud. 91).
        tied: whether another has the same place.
        ratio: its error over that of the first estimator of the table.
        lost: share of its runs that were lost.
    """

    key: str
    place: int
    last: int
    tied: bool
    ratio: Interval
    lost: float


def score(mse: Array, lost: NDArray[np.bool_]) -> Array:
    """One number a run for several coordinates: the mean over them of log RMSE `(run,)`.

    The exponential of a difference is the geometric mean over the coordinates of the ratios of
    RMSE: no unit, no weights, and no coordinate outweighs the others by being large.

    Args:
        mse: mean squared error `(run, coordinate)`.
        lost: whether the run was lost `(run,)`: infinite.
    """
    with np.errstate(invalid="ignore"):
        return np.where(lost, np.inf, 0.5 * np.log(np.maximum(mse, TINY)).mean(axis=1))


def compare(
    scores: Mapping[str, Array], level: float = 0.95, margin: float = 0.01
) -> tuple[list[Pair], list[Rank]]:
    """All pairs, and the ranking that follows.

    Two estimators tie unless Wilcoxon's test tells them apart after Holm's correction over all
    pairs, and the ratio of their errors is off 1, or the shares of lost runs apart, by more than
    the margin in the same direction. Ties are not transitive: a may tie with b and b with c though
    a is better than c; the range of ranks says so.

    Args:
        scores: key -> `score` of the same runs, all in the same order.
        level: confidence; 1 - level is the chance of any false difference.
        margin: a relative difference that is too small to matter, positive.
    """
    keys = list(scores)
    found = [
        (a, b, paired(scores[a], scores[b], level, scale=1.0)) for a, b in combinations(keys, 2)
    ]
    signs, wilcoxons = (holm([getattr(p, k) for *_, p in found]) for k in ("sign", "wilcoxon"))
    pairs = []
    better = dict.fromkeys(keys, 0)
    worse = dict.fromkeys(keys, 0)
    for (a, b, p), sign, wilcoxon in zip(found, signs, wilcoxons):
        size = np.array([p.difference.value / np.log1p(margin), p.lost / margin])
        differ = bool(wilcoxon < 1 - level and (np.sign(p.effect) * size > 1).any())
        pairs.append(Pair(a, b, p, p.difference.exponential(), sign, wilcoxon, differ))
        if differ:
            ahead, behind = (a, b) if p.effect < 0 else (b, a)
            better[behind] += 1
            worse[ahead] += 1
    lost = {k: float(np.mean(~np.isfinite(v))) for k, v in scores.items()}
    mean = {
        k: float(v[np.isfinite(v)].mean()) if lost[k] < 1 else np.inf for k, v in scores.items()
    }
    order = sorted(keys, key=lambda k: (better[k], -worse[k], lost[k], mean[k]))
    places = list(better.values())
    ranks = [
        Rank(
            key=key,
            place=1 + better[key],
            last=len(keys) - worse[key],
            tied=places.count(better[key]) > 1,
            ratio=_difference(scores[key], scores[order[0]], level).exponential(),
            lost=lost[key],
        )
        for key in order
    ]
    return pairs, ranks


def _difference(a: Array, b: Array, level: float) -> Interval:
    """Mean of a - b over the runs that neither lost, with Student's t interval."""
    both = np.isfinite(a) & np.isfinite(b)
    return mean_interval(a[both] - b[both], level)


def fewest_runs(estimators: int, level: float = 0.95) -> int:
    """Runs below which `compare` cannot tell any two apart, however different they are.

    The least p-value of a signed-rank or a sign test of N runs is 2^(1 - N), and Holm multiplies
    it by the count of pairs.
    """
    pairs = max(1, estimators * (estimators - 1) // 2)
    return int(np.floor(np.log2(2 * pairs / (1 - level)))) + 1
