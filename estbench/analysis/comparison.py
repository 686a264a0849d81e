"""Estimators compared in pairs on common random numbers, and ranked with their ties.

Run i has the same truth and readings for all estimators, so two estimators are compared run by run:
random effects common to both cancel. A value that is not finite marks a diverged ("lost") run: it
is worse than every finite value and ties with every other lost run.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats

from estbench.consistency.intervals import Interval, mean_interval
from estbench.consistency.multiplicity import holm
from estbench.consistency.scores import difference
from estbench.shapes import Array

ROUNDING = 1e-9
"""Differences below this part of the values are rounding errors, and count as ties."""


@dataclass(frozen=True)
class Paired:
    """Estimator a minus estimator b, over the runs that both have.

    Attributes:
        runs: count of the runs lost by neither; the difference is over these.
        difference: mean of a - b with Student's t interval.
        lost: share of the runs lost by a minus the share lost by b.
        less, more, ties: runs, lost ones included, in which a is below, above, equal to b.
        effect: (W₊ - W₋)/(W₊ + W₋) of the signed ranks, in [-1, 1]: below 0 where a is less.
        sign: two-sided p-value of the exact sign test: a is below b as often as above.
        wilcoxon: p-value of Wilcoxon's signed-rank test: a - b is symmetric about 0, as it is if
            the two are exchangeable.
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
    """Compare two estimators by one value per run; smaller is better.

    Args:
        a: value of each run `(run,)`, e.g. its RMSE; not finite where it was lost.
        b: the same runs' values of the other estimator `(run,)`.
        level: confidence of the interval.
        scale: size of the values, to recognize rounding errors; default their median size.
    """
    a, b = (np.where(np.isfinite(x), x, np.inf) for x in (a, b))
    both = np.isfinite(a) & np.isfinite(b)
    if scale is None:
        scale = float(np.median(np.abs(np.concatenate([a[both], b[both]])))) if both.any() else 0.0
    exact = a[both] - b[both]
    difference = np.where(np.abs(exact) <= ROUNDING * scale, 0.0, exact)
    # The difference of a lost run is infinite; its rank only has to be the largest.
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


@dataclass(frozen=True)
class Pair:
    """Comparison of two estimators, with p-values adjusted for all pairs.

    Attributes:
        a, b: keys.
        paired: comparison of the scores, which are logarithms.
        ratio: exp of the difference: error of a over error of b.
        sign, wilcoxon: adjusted by Holm.
        differ: whether the difference is significant, and larger than the margin.
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
    """The rank of an estimator.

    Attributes:
        key: the estimator.
        place: 1 + the count of better ones; all differences are significant after Holm.
        last: the count of all minus the count of worse ones. The ranks of all estimators are in
            their [place, last] at once, at the given level (Mogstad et al. 2024, Rev. Econ.
            Stud. 91).
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


def compare(
    scores: Mapping[str, Array], level: float = 0.95, margin: float = 0.01
) -> tuple[list[Pair], list[Rank]]:
    """All pairs, and the ranking.

    Two estimators tie unless Wilcoxon's test is significant after Holm's correction over all pairs,
    and the ratio of their errors differs from 1, or their shares of lost runs differ, by more than
    the margin in the same direction. Ties are not transitive: a may tie with b and b with c
    although a is better than c. The range of ranks shows it.

    Args:
        scores: key -> `consistency.scores.score` of the same runs, all in the same order.
        level: confidence; 1 - level is the probability of any false difference.
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
            ratio=difference(scores[key], scores[order[0]], level).exponential(),
            lost=lost[key],
        )
        for key in order
    ]
    return pairs, ranks


def fewest_runs(estimators: int, level: float = 0.95) -> int:
    """The least count of runs with which `compare` can find any two estimators different.

    The least p-value of a signed-rank or a sign test of N runs is 2^(1 - N), and Holm multiplies
    it by the count of pairs.
    """
    pairs = max(1, estimators * (estimators - 1) // 2)
    return int(np.floor(np.log2(2 * pairs / (1 - level)))) + 1
