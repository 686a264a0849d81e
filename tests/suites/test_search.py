"""Greedy and exhaustive search, against all subsets."""

from itertools import combinations

import numpy as np
import pytest

from estbench.suites.search import cheapest, greedy, pruned

NAMES = ("a", "b", "c", "d", "e", "f")


def subsets():
    return [frozenset(c) for k in range(len(NAMES) + 1) for c in combinations(NAMES, k)]


def problem(seed):
    """½ log det(1 + Σ hᵢ hᵢᵀ) of six channels of three coordinates, and the variances."""
    rng = np.random.default_rng(seed)
    rows = dict(zip(NAMES, rng.standard_normal((6, 3)) * rng.uniform(0.2, 4.0, (6, 1))))
    # Some channels measure nearly the same: there a greedy choice can be wrong.
    rows["b"], rows["d"] = rows["a"] * 1.01, 0.8 * rows["a"] + 0.8 * rows["c"]

    def matrix(chosen):
        return np.eye(3) + sum((np.outer(rows[n], rows[n]) for n in chosen), np.zeros((3, 3)))

    def measure(chosen):
        return np.array([0.5 * np.linalg.slogdet(matrix(c))[1] for c in chosen])

    def variances(chosen):
        return np.array([np.diag(np.linalg.inv(matrix(c))) for c in chosen])

    return measure, variances


def test_greedy_is_never_below_its_guarantee():
    worst = 1.0
    for seed in range(40):
        measure, _ = problem(seed)
        order, values = greedy(NAMES, measure)
        assert sorted(order) == list(NAMES)
        for k in range(1, 7):
            best = measure([frozenset(c) for c in combinations(NAMES, k)]).max()
            worst = min(worst, values[k - 1] / best)
        assert values[0] == pytest.approx(measure([frozenset(n) for n in NAMES]).max())
    assert 1 - 1 / np.e <= worst < 1.0  # below the best somewhere, and never by more


def test_the_cheapest_suite_is_that_of_all_subsets():
    rng = np.random.default_rng(3)
    different = 0
    for seed in range(20):
        measure, variances = problem(seed)
        cost = dict(zip(NAMES, rng.integers(0, 5, 6).astype(float)))
        limit = 1.3 * variances([frozenset(NAMES)])[0]

        def meets(chosen, variances=variances, limit=limit):
            return (variances(chosen) <= limit).all(axis=1).tolist()

        found = cheapest(NAMES, cost, meets)
        every = [s for s, fine in zip(subsets(), meets(subsets())) if fine]
        least = min(sum(cost[n] for n in s) for s in every)
        assert meets([found])[0]
        assert sum(cost[n] for n in found) == least
        order, _ = greedy(NAMES, measure)
        quick = pruned(order, cost, meets)
        assert meets([quick])[0]
        assert not any(meets([quick - {n}])[0] for n in quick)
        different += quick != found
    assert different  # the exhaustive search is worth its time
