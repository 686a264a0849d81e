import numpy as np
import pytest
from scipy import stats

from estbench.consistency.coverage import EXPECTED, SIGMAS, coverage, inside


def test_expected_shares_are_those_of_a_normal_error():
    np.testing.assert_allclose(EXPECTED, [stats.norm.cdf(k) - stats.norm.cdf(-k) for k in SIGMAS])


def test_inside_by_hand():
    error = np.array([[[0.5], [-2.0]], [[-1.0], [np.nan]], [[2.5], [1.0]], [[3.5], [6.0]]])
    std = np.array([[[1.0], [1.0]], [[1.0], [1.0]], [[1.0], [0.0]], [[1.0], [2.0]]])
    # (step, run, coordinate); run 0: 0.5 1 2.5 3.5, run 1: 2 NaN (known exactly) 3
    np.testing.assert_allclose(
        inside(error, std).value[:, 0], [[0.5, 0.5, 0.75], [0.0, 1 / 3, 2 / 3]]
    )
    assert np.isnan(inside(error, np.zeros_like(std)).value).all()  # no step counts


def test_mean_and_interval_across_runs():
    shares = np.array([[0.6, 0.9, 1.0], [0.7, 1.0, 1.0], [0.8, 0.8, 1.0]])
    found = coverage(shares).shares
    half = stats.t.ppf(0.975, 2) * 0.1 / np.sqrt(3)
    assert found[0].value == pytest.approx(0.7)
    assert [found[0].low, found[0].high] == pytest.approx([0.7 - half, 0.7 + half])
    assert found[1].high == 1.0  # cut
    assert (found[2].low, found[2].high) == (1.0, 1.0)


def test_a_group_is_the_mean_of_its_coordinates():
    shares = np.random.default_rng(0).uniform(size=(8, 4, 3))
    assert coverage(shares) == coverage(shares.mean(axis=1))


def test_normal_errors_are_inside_as_often_as_expected():
    # 400 experiments of 20 runs x 100 steps x 2 coordinates at 95%: of 1σ and 2σ 20 misses are
    # expected, sigma 4.4; 6 sigma, 2e-9. Of 3σ, skewed, twice that.
    rng = np.random.default_rng(1)
    missed = np.zeros(3)
    for _ in range(400):
        std = rng.uniform(0.5, 2, (1, 20, 2))
        shares = inside(
            std * rng.standard_normal((100, 20, 2)), np.broadcast_to(std, (100, 20, 2))
        ).value
        missed += [not ok for ok in coverage(shares).as_expected]
    assert (np.abs(missed[:2] - 20) < 27).all()
    assert missed[2] < 20 + 20 + 27


def test_a_filter_that_reports_half_its_error():
    error = np.random.default_rng(2).standard_normal((500, 40, 1))
    found = coverage(inside(error, np.full_like(error, 0.5)).value)
    assert found.shares[1].value == pytest.approx(EXPECTED[0], abs=0.02)
    assert not any(found.as_expected)
