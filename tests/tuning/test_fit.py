import numpy as np
import pytest
from scipy import optimize

from estbench.errors import StudyError
from estbench.estimators.kf import KF
from estbench.tuning.evaluation import Evaluation
from estbench.tuning.memory import Memory
from estbench.tuning.parameters import Parameter, Prior, with_priors
from estbench.tuning.tune import fit
from estbench.tuning.uncertainty import in_words
from tests.tuning import linear


@pytest.fixture(scope="module")
def y():
    return linear.readings()


@pytest.fixture(scope="module")
def memory(y):
    return Memory(linear.given(y))


@pytest.fixture(scope="module")
def found(memory):
    return fit(linear.parameters(), memory)


def test_the_maximum_is_that_of_the_exact_likelihood(y, found, memory):
    direct = optimize.minimize(
        lambda x: linear.dense(y, np.exp(x)).mean(), np.log(linear.TRUE), method="BFGS",
        options={"gtol": 1e-9},
    )  # fmt: skip
    np.testing.assert_allclose(np.log(found.values), direct.x, atol=1e-6)
    np.testing.assert_allclose(found.loss[1], direct.fun, rtol=1e-12)
    assert memory.sets <= 40


def test_standard_errors_are_those_of_the_exact_curvature(y, found):
    h, x = 1e-3, np.log(found.values)

    def total(x):
        return linear.dense(y, np.exp(x)).sum()

    e = h * np.eye(2)
    H = np.array(
        [
            [total(x + a + b) - total(x + a - b) - total(x - a + b) + total(x - a - b) for b in e]
            for a in e
        ]
    )
    cov = np.linalg.inv(H / (4 * h**2))
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(found.uncertainty.std, std, rtol=1e-3)
    rho = cov[0, 1] / std[0] / std[1]
    np.testing.assert_allclose(found.uncertainty.correlation[0, 1], rho, atol=1e-3)
    assert (np.abs(x - np.log(linear.TRUE)) < 4 * std).all()
    assert not in_words(found.problem.parameters, found.uncertainty)


def test_the_profile_of_the_likelihood_is_near_the_paraboloid(found):
    for profile, value in zip(found.profiles, found.values):
        assert profile.values[4] == pytest.approx(value)
        assert profile.loss[4] == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(profile.loss[3:6], profile.expected[3:6], rtol=0.5, atol=1e-9)
        assert (profile.loss[[0, 8]] > 1.5).all()


def test_standard_errors_are_calibrated():
    """z² of 2 x 16 estimates: their mean leaves [0.4, 1.95] with probability below 2e-3."""
    z = []
    for seed in range(16):
        y = linear.readings(seed, 20, 20)
        one = fit(linear.parameters((0.4, 0.4), 100.0), Memory(linear.given(y)))
        z.append((np.log(one.values) - np.log(linear.TRUE)) / one.uncertainty.std)
    z = np.array(z)
    assert np.isfinite(z).all()
    assert 0.4 < (z**2).mean() < 1.95
    assert np.abs(z).max() < 4.5


def test_the_optimum_does_not_depend_on_units(y, found):
    def scaled(values):
        model = linear.model(np.multiply(values, 1e6))  # variances in 1e-3 units
        return KF(model)

    mean, cov = linear.prior()
    other = linear.Given(scaled, mean, 1e6 * cov, 1e3 * y)
    again = fit(linear.parameters(), Memory(other))
    np.testing.assert_allclose(again.values, found.values, rtol=1e-5)
    np.testing.assert_allclose(again.uncertainty.std, found.uncertainty.std, rtol=1e-3)


def test_the_optimum_does_not_depend_on_the_rate_of_the_filter(y, found):
    """Three predictions for each measurement: the density of Q and R stay what they are."""

    def often(values):
        return KF(linear.model((values[0] / 3, values[1])))  # Q of a third of the interval

    between = np.full((3 * len(y), *y.shape[1:]), np.nan)
    between[2::3] = y
    again = fit(linear.parameters(), Memory(linear.given(between, often)))
    np.testing.assert_allclose(again.values, found.values, rtol=1e-6)
    np.testing.assert_allclose(again.uncertainty.std, found.uncertainty.std, rtol=1e-6)


def test_a_prior_moves_the_estimate_by_what_it_knows(y, found):
    (q, r) = with_priors(linear.parameters(), [("q", Prior(0.3, 1.05))])
    both = fit((q, r), Memory(linear.given(y)))

    def loss(x):
        known = (x[0] - np.log(0.3)) / np.log(1.05)
        return linear.dense(y, np.exp(x)).sum() + 0.5 * known**2

    direct = optimize.minimize(loss, np.log(linear.TRUE), method="BFGS")
    np.testing.assert_allclose(np.log(both.values), direct.x, atol=1e-4)
    assert both.uncertainty.std[0] < np.log(1.05) < found.uncertainty.std[0]


def test_what_the_data_do_not_determine_is_named(y):
    """R = a b: only the product is determined."""

    def make(values):
        a, b = values
        return KF(linear.model((0.3, a * b)))

    free = linear.parameters((1.0, 2.0), 50.0, ("a", "b"))
    one = fit(free, Memory(linear.given(y, make)))
    assert np.isinf(one.uncertainty.std).all()
    (words,) = in_words(free, one.uncertainty)
    assert "a up, b down together" in words or "b up, a down together" in words
    assert one.values[0] * one.values[1] == pytest.approx(0.5, rel=0.5)


def test_an_end_of_the_range_is_named(y):
    q, _ = linear.parameters()
    free = (q, Parameter(("r",), "r", 2.0, 1.0, 4.0, True))
    one = fit(free, Memory(linear.given(y)))
    assert one.values[1] == 1.0
    assert np.isnan(one.uncertainty.std[1])
    (words,) = in_words(free, one.uncertainty)
    assert words.startswith("r is at an end of its range, 1 to 4; widen it")


@pytest.mark.parametrize(("method", "iterations"), [("nelder-mead", 100), ("evolution", 12)])
def test_searches_without_slopes_find_the_same(y, found, method, iterations):
    free = linear.parameters((1.0, 0.2), 30.0)
    one = fit(free, Memory(linear.given(y)), method=method, iterations=iterations)
    np.testing.assert_allclose(np.log(one.values), np.log(found.values), atol=0.05)
    assert one.uncertainty is None


class Fragile(linear.Given):
    """Refuses a part of the range between the start and the best values."""

    def __call__(self, candidates):
        ok = super().__call__(candidates)
        bad = [5.0 > values[0] > 2.0 for values in candidates]
        ll = np.where(np.array(bad)[:, None], np.nan, ok.log_likelihood)
        return Evaluation(ll, None, None, None, tuple("out of order" * b for b in bad))


def test_candidates_that_fail_are_bad_not_fatal(y, found):
    def make(values):
        return KF(linear.model(values))

    source = Fragile(make, *linear.prior(), y)
    one = fit(linear.parameters((1.5, 0.005)), Memory(source))
    np.testing.assert_allclose(np.log(one.values), np.log(found.values), atol=1e-3)
    free = linear.parameters((6.0, 0.5), 30.0)
    one = fit(free, Memory(source), method="evolution", iterations=8)
    np.testing.assert_allclose(np.log(one.values), np.log(found.values), atol=0.2)
    assert one.refused["out of order"] >= 1


def test_objectives_that_do_not_fit(y):
    memory = Memory(linear.given(y))
    free = linear.parameters()
    with pytest.raises(StudyError, match="needs the true state, which recorded readings lack"):
        fit(free, memory, objective="mse")
    with pytest.raises(StudyError, match="use one of likelihood, mse, consistent-mse"):
        fit(free, memory, objective="nees")
    with pytest.raises(StudyError, match="which the likelihood does not know"):
        fit(free, memory, coordinates={"x": 1.0})
    with pytest.raises(StudyError, match="use one of auto, quasi-newton"):
        fit(free, memory, method="gradient")
