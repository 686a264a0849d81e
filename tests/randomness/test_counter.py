import numpy as np
import pytest
from scipy import stats

from estbench.randomness import counter as random
from tests.helpers import random_cov

KEYS = random.default_keys(64)


def counters(value: int, runs: int = 64):
    return np.full(runs, value, np.uint64)


def test_first_words_are_splitmix64():
    # Reference: the C code of Vigna's splitmix64.c, restated with Python integers.
    def mix(z):
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
        z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
        return z ^ (z >> 31)

    step = 0x9E3779B97F4A7C15
    state = mix((7 + step) % 2**64)
    for word in (3, 2 + 1):
        state = mix((state + word * step) % 2**64)
    expected = [mix((state + i * step) % 2**64) for i in (1, 2, 3)]
    got = random.bits(np.array([7], np.uint64), np.array([3], np.uint64), 2, 3)
    assert [int(w) for w in got[0]] == expected


def test_known_first_output_of_splitmix64():
    # splitmix64 seeded with 0 begins with this word, as published with xoshiro's seeding advice.
    assert int(random._mix(np.array([0x9E3779B97F4A7C15], np.uint64))[0]) == 0xE220A8397B1DCDAF


def test_a_run_has_the_same_numbers_in_any_batch():
    whole = random.normal(KEYS, counters(5), 0, 4, 3)
    alone = random.normal(KEYS[10:11], counters(5, 1), 0, 4, 3)
    np.testing.assert_array_equal(whole[10:11], alone)


def test_uniforms_pass_a_kolmogorov_smirnov_test():
    sample = random.uniform(KEYS, counters(1), 0, 2000)
    assert sample.min() > 0
    assert sample.max() < 1
    assert stats.kstest(sample.ravel(), "uniform").pvalue > 1e-3


def test_extreme_words_stay_inside_the_open_interval(monkeypatch):
    for word in (0, 2**64 - 1):
        extreme = np.full((1, 1), word, np.uint64)
        monkeypatch.setattr(random, "bits", lambda *a, extreme=extreme: extreme)
        assert 0 < random.uniform(KEYS[:1], counters(0, 1), 0, 1)[0, 0] < 1
        assert np.isfinite(random.normal(KEYS[:1], counters(0, 1), 0, 1)).all()


def test_normals_have_the_right_moments():
    sample = random.normal(KEYS, counters(2), 0, 4000).ravel()
    count = sample.size
    for power, expected, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert abs((sample**power).mean() - expected) < 4 * np.sqrt(variance / count)


@pytest.mark.parametrize("varied", ["key", "counter", "purpose", "index"])
def test_neighbouring_streams_are_uncorrelated(varied):
    count = 20_000
    if varied == "key":
        sample = random.normal(KEYS, counters(0), 0, count)
    elif varied == "counter":
        sample = random.normal(np.zeros(64, np.uint64), np.arange(64, dtype=np.uint64), 0, count)
    elif varied == "purpose":
        one = np.zeros(1, np.uint64)
        sample = np.concatenate([random.normal(one, one, p, count) for p in range(64)])
    else:
        sample = random.normal(random.default_keys(count), counters(0, count), 0, 64).T
    correlation = np.asarray(np.corrcoef(sample))[np.triu_indices(64, 1)] * np.sqrt(count)
    # The 2016 pairs are standard normal: the largest is below 5, the mean square is 1 ± 0.13.
    assert np.abs(correlation).max() < 5
    assert abs((correlation**2).mean() - 1) < 4 * np.sqrt(2 / 2016)


def test_flipping_one_key_bit_flips_half_of_the_output_bits():
    base = np.full(64, 12345, np.uint64)
    flipped = base ^ (np.uint64(1) << np.arange(64, dtype=np.uint64))
    differ = random.bits(base, counters(0), 0, 100) ^ random.bits(flipped, counters(0), 0, 100)
    share = np.bitwise_count(differ).mean(axis=1) / 64  # one for each of the key's bits
    assert np.abs(share - 0.5).max() < 5 * 0.5 / np.sqrt(6400)


def test_square_root_of_definite_singular_and_indefinite():
    rng = np.random.default_rng(0)
    definite = random_cov(rng, 3)
    singular = np.outer([1.0, 2.0, 0.0], [1.0, 2.0, 0.0])
    indefinite = np.diag([1.0, -0.1, 1.0])
    root = random.square_root(np.array([definite, singular, indefinite, np.zeros((3, 3))]))
    np.testing.assert_allclose(root[0] @ root[0].T, definite, atol=1e-12)
    np.testing.assert_allclose(root[1] @ root[1].T, singular, atol=1e-12)
    assert np.isnan(root[2]).any()
    np.testing.assert_array_equal(root[3], 0)


def test_gaussian_samples_have_the_covariance():
    cov = random_cov(np.random.default_rng(1), 3)
    sample = random.gaussian(KEYS, counters(9), 1, cov, 1000).reshape(-1, 3)
    white = sample @ np.linalg.inv(np.linalg.cholesky(cov)).T
    assert np.abs(white.T @ white / len(white) - np.eye(3)).max() < 4 * np.sqrt(2 / len(white))
