"""Seeded samples: the tests pass or fail always; a fresh seed would fail with probability 1e-3."""

import numpy as np
import pytest
from scipy import stats

from estbench.randomness import counter
from estbench.randomness.orthogonal import haar

KEYS = counter.default_keys(2000)
ZERO = np.zeros(2000, np.uint64)


@pytest.mark.parametrize("n", [1, 2, 5, 28])
def test_orthogonal(n):
    found = haar(KEYS[:50], ZERO[:50], 0, 2, n)
    assert found.shape == (50, 2, n, n)
    np.testing.assert_allclose(found @ found.mT, np.tile(np.eye(n), (50, 2, 1, 1)), atol=1e-13)


def test_each_column_is_uniform_on_the_sphere():
    """In three dimensions every coordinate is then uniform in [-1, 1] (Archimedes)."""
    sample = haar(KEYS, ZERO, 1, 1, 3)[:, 0]
    for i in range(3):
        for j in range(3):
            assert stats.kstest(sample[:, i, j], "uniform", (-1, 2)).pvalue > 1e-3


def test_the_distribution_is_that_of_the_haar_measure():
    """Traces have mean 0, mean square 1 and mean fourth power 3 (Diaconis & Shahshahani 1994).

    Multiplication by a fixed orthogonal matrix changes no distribution. Without the correction of
    the signs the mean of the trace would be -2.9.
    """
    sample = haar(KEYS, ZERO, 2, 1, 6)[:, 0]
    fixed = np.linalg.qr(np.random.default_rng(0).standard_normal((6, 6)))[0]
    for matrices in (sample, fixed @ sample):
        trace = np.trace(matrices, axis1=-2, axis2=-1)
        for power, expected in ((1, 0.0), (2, 1.0), (4, 3.0)):
            values = trace**power
            assert abs(values.mean() - expected) < 3.3 * values.std() / np.sqrt(len(values))
    reflections = (np.linalg.det(sample) < 0).sum()
    assert stats.binomtest(int(reflections), len(sample)).pvalue > 1e-3


def test_a_run_has_the_same_matrices_in_any_batch_and_others_at_other_times():
    whole = haar(KEYS[:8], ZERO[:8], 0, 3, 5)
    np.testing.assert_array_equal(whole[2:4], haar(KEYS[2:4], ZERO[2:4], 0, 3, 5))
    for other in (haar(KEYS[:8], ZERO[:8] + 1, 0, 3, 5), haar(KEYS[:8], ZERO[:8], 1, 3, 5)):
        assert np.abs(other - whole).max(axis=(-2, -1)).min() > 0.1
