import numpy as np
import pytest

from estbench.consistency.credibility import credibility, expected


def made(runs=200, steps=3, n=2, scale=1.0, seed=0):
    """Errors with a covariance, and NEES by `scale` times that covariance."""
    rng = np.random.default_rng(seed)
    root = np.array([[1.0, 0.0], [0.7, 0.3]]) if n == 2 else np.eye(n)
    error = rng.standard_normal((runs, steps, n)) @ root.T
    P = scale * root @ root.T
    return error, np.einsum("rki,ij,rkj->rk", error, np.linalg.inv(P), error)


def whole(error, nees):
    return credibility(lambda: [(error, nees)])


def test_by_hand():
    error, nees = made(runs=30)
    found = whole(error, nees)
    for k in range(3):
        e = error[:, k]
        square = sum(np.outer(x, x) for x in e) / 30
        ratio = [nees[i, k] / (x @ np.linalg.solve(square, x)) for i, x in enumerate(e)]
        assert found.nci[k] == pytest.approx(10 * np.mean(np.abs(np.log10(ratio))))
        assert found.inclination[k] == pytest.approx(10 * np.mean(np.log10(ratio)))


@pytest.mark.parametrize(("scale", "decibels"), [(0.25, 6.02), (1.0, 0.0), (4.0, -6.02)])
def test_inclination_is_the_factor_on_the_covariance(scale, decibels):
    found = whole(*made(runs=4000, scale=scale))
    np.testing.assert_allclose(found.inclination, decibels, atol=0.15)
    np.testing.assert_allclose(found.nci, abs(decibels), atol=0.25)


def test_unlike_nees_optimism_here_does_not_pay_for_pessimism_there():
    error, nees = made(runs=2000)
    half = np.where(np.arange(2000)[:, None] < 1000, 0.5, 2.0)
    found = whole(error, nees * half)
    assert abs(found.inclination.mean()) < 0.15
    assert found.nci.mean() == pytest.approx(3.01, abs=0.15)


def test_a_change_of_units_changes_nothing():
    error, nees = made(runs=50)
    one, other = whole(error, nees), whole(error * [1e3, 1e-5], nees)
    np.testing.assert_allclose(other.nci, one.nci, rtol=1e-6)


def test_batches_are_one_experiment():
    error, nees = made(runs=50)
    parts = [(error[a:b], nees[a:b]) for a, b in ((0, 20), (20, 20), (20, 50))]
    found, one = credibility(lambda: iter(parts)), whole(error, nees)
    np.testing.assert_allclose(found.nci, one.nci)
    np.testing.assert_allclose(found.inclination, one.inclination)


@pytest.mark.parametrize(("n", "runs"), [(2, 25), (2, 400), (6, 60)])
def test_expected_of_a_credible_estimator(n, runs):
    error = np.random.default_rng(n + runs).standard_normal((runs, 300, n))
    found = whole(error, (error**2).sum(axis=-1))
    # Both are means over at least 200 steps, each with a spread of some 20%: 6 sigma below 10%.
    assert found.expected == pytest.approx(found.nci.mean(), rel=0.1)


def test_too_few_runs_and_none():
    assert np.isnan(expected(4, 4))
    assert np.isnan(whole(*made(runs=2, n=3)).nci).all()
    assert np.isnan(credibility(lambda: []).nci).all()
    assert np.isnan(whole(np.empty((0, 3, 2)), np.empty((0, 3))).nci).all()
