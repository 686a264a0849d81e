import numpy as np
import pytest

from estbench.consistency.multiplicity import holm


def by_hand(p, w, level):
    """Holm's procedure as it is stated: reject while p <= level w / (sum of the weights left)."""
    left, rejected = list(range(len(p))), set()
    while left:
        i = min(left, key=lambda k: p[k] / w[k])
        if p[i] > level * w[i] / sum(w[k] for k in left):
            break
        rejected.add(i)
        left.remove(i)
    return rejected


@pytest.mark.parametrize("seed", range(8))
def test_adjusted_p_values_are_those_of_the_procedure(seed):
    rng = np.random.default_rng(seed)
    p, w = rng.uniform(0, 0.2, 9) ** 2, rng.uniform(0.1, 3.0, 9)
    for level in (0.01, 0.05, 0.2):
        assert set(np.flatnonzero(holm(p, w) <= level)) == by_hand(p, w, level)
        assert set(np.flatnonzero(holm(p) <= level)) == by_hand(p, np.ones(9), level)


def test_equal_weights_are_no_weights():
    p = [0.01, 0.04, 0.03, 0.2]
    np.testing.assert_allclose(holm(p, [7, 7, 7, 7]), holm(p))
    np.testing.assert_allclose(holm(p), [0.04, 0.09, 0.09, 0.2])


def test_a_hypothesis_of_more_weight_is_refuted_sooner():
    np.testing.assert_allclose(holm([0.03, 0.03], [9, 1]), [1 / 30, 1 / 30])
    np.testing.assert_allclose(holm([0.03, 0.03], [1, 1]), [0.06, 0.06])
