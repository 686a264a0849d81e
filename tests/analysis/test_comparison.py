from itertools import combinations, product
from math import comb

import numpy as np
import pytest
from scipy import stats

from estbench.analysis.comparison import (
    compare,
    fewest_runs,
    holm,
    paired,
)
from estbench.consistency.intervals import Interval

INF = np.inf

# Pairs


def test_pair_by_hand():
    a = np.array([1.0, 2.0, 3.0, 4.0, 9.0])
    b = np.array([2.0, 4.0, 6.0, 3.5, 9.0])
    p = paired(a, b)
    d = np.array([-1, -2, -3, 0.5, 0])
    assert (p.runs, p.less, p.more, p.ties) == (5, 3, 1, 1)
    half = stats.t.ppf(0.975, 4) * d.std(ddof=1) / np.sqrt(5)
    assert p.difference.value == pytest.approx(d.mean())
    assert [p.difference.low, p.difference.high] == pytest.approx(
        [d.mean() - half, d.mean() + half]
    )
    assert p.sign == pytest.approx(2 * (1 + 4) / 16)  # 1 or fewer of 4, both sides
    assert p.effect == pytest.approx((1 - 2 - 3 - 4) / 10)


@pytest.mark.parametrize("n", [5, 9, 30])
def test_sign_test_by_counting(n):
    rng = np.random.default_rng(n)
    a, b = rng.normal(0.4, 1, n), np.zeros(n)
    p = paired(a, b)
    k = min(p.less, p.more)
    assert p.sign == pytest.approx(min(1.0, 2 * sum(comb(n, i) for i in range(k + 1)) / 2**n))


@pytest.mark.parametrize("seed", range(4))
def test_wilcoxon_by_enumerating_all_signs(seed):
    d = np.random.default_rng(seed).normal(0.5, 1, 9)
    ranks = stats.rankdata(np.abs(d))
    smaller = min(ranks[d > 0].sum(), ranks[d < 0].sum())
    every = [
        min((ranks * (np.array(s) > 0)).sum(), (ranks * (np.array(s) < 0)).sum())
        for s in product((-1, 1), repeat=9)
    ]
    assert paired(d, np.zeros(9)).wilcoxon == pytest.approx(np.mean(np.array(every) <= smaller))


def test_lost_runs_count_in_the_tests_and_not_in_the_difference():
    a = np.array([1.0, 1.0, 1.0, 1.0, np.nan, INF, 1.0])
    b = np.array([2.0, 3.0, 4.0, INF, 1.0, np.nan, 6.0])
    p = paired(a, b)
    assert (p.runs, p.less, p.more, p.ties) == (4, 5, 1, 1)
    assert p.difference.value == pytest.approx(-2.75)
    assert p.lost == pytest.approx(2 / 7 - 2 / 7)
    # The two runs that one lost have the largest ranks, tied: 5.5 each of 1 2 3 4 5.5 5.5.
    assert p.effect == pytest.approx((5.5 - 5.5 - 1 - 2 - 3 - 4) / 21)


def test_rounding_is_a_tie():
    b = np.random.default_rng(0).uniform(1, 2, 40)
    p = paired(b * (1 + 1e-13), b)
    assert (p.ties, p.sign, p.wilcoxon, p.effect) == (40, 1.0, 1.0, 0.0)


def test_nothing_to_compare():
    p = paired(np.full(3, np.nan), np.array([1.0, np.nan, 2.0]))
    assert p.runs == 0
    assert np.isnan(p.difference.value)
    assert (p.less, p.more, p.ties) == (0, 2, 1)


def test_p_values_are_uniform_when_the_two_are_exchangeable():
    # False alarms at 5% in 800 experiments: 40 expected, sigma 6.2; 6 sigma, 2e-9.
    rng = np.random.default_rng(1)
    common = rng.normal(size=(800, 1, 20))
    values = common + rng.gamma(1.0, size=(800, 2, 20))
    found = [paired(a, b) for a, b in values]
    assert abs(sum(p.wilcoxon < 0.05 for p in found) - 40) < 37
    assert sum(p.sign < 0.05 for p in found) < 40 + 37  # discrete: 4.1% at 20 runs
    assert abs(sum(0.0 not in p.difference for p in found) - 40) < 37


# Many pairs


@pytest.mark.parametrize("seed", range(5))
def test_holm_is_the_closed_test_with_bonferroni(seed):
    p = np.random.default_rng(seed).uniform(0, 0.2, 5)
    adjusted = holm(p.tolist())
    for i in range(5):
        closed = max(
            min(1.0, len(subset) * min(p[list(subset)]))
            for size in range(1, 6)
            for subset in combinations(range(5), size)
            if i in subset
        )
        assert adjusted[i] == pytest.approx(closed)


def test_holm_of_none_and_one():
    assert holm([]).size == 0
    assert holm([0.3]).tolist() == [0.3]
    assert holm([0.9, 0.8]).tolist() == [1.0, 1.0]


def test_false_differences_among_equals_are_as_rare_as_the_level_says():
    # Any of six pairs in 100 experiments, level 90%: at most 10 expected, sigma 3; 5 sigma.
    rng, alarms = np.random.default_rng(2), 0
    for _ in range(100):
        luck = rng.normal(size=25)
        scores = {k: luck + 0.3 * rng.normal(size=25) for k in "abcd"}
        pairs, _ = compare(scores, 0.9, margin=1e-9)
        alarms += any(p.differ for p in pairs)
    assert alarms < 10 + 15


# Scores and ranks


def made(ratio, spread=0.02, lost=0, runs=60, seed=0):
    """Scores of an estimator whose errors are `ratio` times those of the first."""
    luck = np.random.default_rng(99).normal(0, 0.3, runs)
    own = np.random.default_rng(seed).normal(0, spread, runs)
    out = luck + np.log(ratio) + own - own.mean()
    out[:lost] = INF
    return out


def test_ranking_shows_ties_as_ties():
    scores = {
        "far": made(2.0, seed=1), "good": made(1.0, seed=2), "same": made(1.0, seed=3),
        "near": made(1.004, 1e-4, seed=4), "lossy": made(1.0, lost=24, seed=5),
    }  # fmt: skip
    pairs, ranks = compare(scores)
    assert len(pairs) == 10
    by = {r.key: r for r in ranks}
    places = {k: (r.place, r.last, r.tied) for k, r in by.items()}
    assert places == {
        "good": (1, 3, True), "same": (1, 3, True), "near": (1, 3, True),
        "lossy": (4, 5, True), "far": (4, 5, True),
    }  # fmt: skip
    assert by["lossy"].lost == 24 / 60
    assert by["far"].ratio.value == pytest.approx(2.0, rel=0.01)
    assert 2.0 in by["far"].ratio


def test_a_small_significant_difference_needs_a_small_margin():
    scores = {"a": made(1.0, 1e-4, seed=1), "b": made(1.004, 1e-4, seed=2)}
    assert not compare(scores)[0][0].differ
    pairs, ranks = compare(scores, margin=0.001)
    assert pairs[0].differ
    assert [(r.key, r.place, r.tied) for r in ranks] == [("a", 1, False), ("b", 2, False)]


def test_ties_need_not_be_transitive():
    rng = np.random.default_rng(5)
    luck, noise = rng.normal(0, 0.3, 40), rng.normal(0, 1, (3, 40))
    noise -= noise.mean(axis=1, keepdims=True)
    scores = {k: luck + s + 0.1 * e for k, s, e in zip("abc", (0, 0.035, 0.07), noise)}
    pairs, ranks = compare(scores)
    assert {(p.a, p.b): p.differ for p in pairs} == {
        ("a", "b"): False, ("a", "c"): True, ("b", "c"): False,
    }  # fmt: skip
    assert [(r.key, r.place, r.last) for r in ranks] == [("a", 1, 2), ("b", 1, 3), ("c", 2, 3)]


def test_an_estimator_that_lost_every_run_is_last():
    _, ranks = compare({"gone": np.full(30, np.nan), "there": made(1.0, runs=30)})
    assert [(r.key, r.place) for r in ranks] == [("there", 1), ("gone", 2)]
    assert np.isnan(ranks[1].ratio.value)


def test_one_estimator():
    pairs, ranks = compare({"ekf": made(1.0)})
    assert not pairs
    assert (ranks[0].place, ranks[0].last, ranks[0].tied) == (1, 1, False)


@pytest.mark.parametrize("estimators", [2, 3, 6])
def test_fewest_runs_is_where_the_clearest_difference_shows(estimators):
    n = fewest_runs(estimators)
    for runs, differs in ((n, True), (n - 1, False)):
        clear = np.arange(runs) / 100
        scores = {str(k): clear + k * (1 + clear) for k in range(estimators)}
        assert any(p.differ for p in compare(scores)[0]) == differs


def test_exponential():
    i = Interval(0.0, -INF, np.log(2)).exponential()
    assert (i.value, i.low, i.high) == pytest.approx((1.0, 0.0, 2.0))
