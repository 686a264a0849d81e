import numpy as np
import pytest
from scipy import stats

from estbench.consistency import whiteness as module
from estbench.consistency.whiteness import Whiteness, portmanteau


def sums(white, lags=10):
    """Products and terms of whitened innovations `(step, run, m)`, with loops."""
    steps, runs, m = white.shape
    products = np.zeros((runs, lags + 1))
    for lag in range(lags + 1):
        for k in range(lag, steps):
            products[:, lag] += (white[k] * white[k - lag]).sum(axis=-1)
    terms = np.tile([m * max(steps - lag, 0) for lag in range(lags + 1)], (runs, 1))
    return products, terms


def whiteness(products, terms) -> Whiteness:
    found = module.whiteness(products, terms)
    assert found is not None
    return found


def test_one_dimension_is_the_textbook_statistic():
    x = np.random.default_rng(0).standard_normal((80, 1, 1))
    n, h, y = 80, 10, x[:, 0, 0]
    rho = [(y[lag:] * y[: n - lag]).sum() / (y**2).sum() for lag in range(1, h + 1)]
    textbook = n * (n + 2) * sum(r**2 / (n - lag) for lag, r in enumerate(rho, 1))
    # Ours divides each sum by its own count of terms: (n - l)/n in place of n/(n - l).
    ours = (n + 2) / n * sum((n - lag) * (r * n / (n - lag)) ** 2 for lag, r in enumerate(rho, 1))
    assert portmanteau(*sums(x))[0] == pytest.approx(ours)
    assert ours == pytest.approx(textbook)


@pytest.mark.parametrize("m", [1, 2, 5])
def test_degrees_of_freedom_are_the_lags_whatever_the_dimension(m):
    # Mean h and variance 2 h of chi-square, by 4000 runs: 6 sigma, 2e-9, with 2% for finite steps.
    white = np.random.default_rng(m).standard_normal((150, 4000, m))
    q = portmanteau(*sums(white))
    assert q.mean() == pytest.approx(10, abs=6 * np.sqrt(20 / 4000) + 0.2)
    assert q.var() == pytest.approx(20, rel=0.25)


@pytest.mark.parametrize(("steps", "m"), [(60, 1), (60, 3), (300, 2)])
def test_white_innovations_are_refused_as_often_as_the_level_says(steps, m):
    white = np.random.default_rng(steps + m).standard_normal((steps, 3000, m))
    found = whiteness(*sums(white))
    # 6 sigma of 5% in 3000 is 2.4 points; 1 point for the finite steps of the shortest.
    assert abs(found.rejected.value - 0.05) < 0.024 + 0.01


def test_the_pooled_test_is_calibrated():
    # 400 experiments of 5 runs: 20 false alarms expected, sigma 4.4; 6 sigma.
    white = np.random.default_rng(3).standard_normal((100, 2000, 2))
    products, terms = sums(white)
    p = [whiteness(products[i : i + 5], terms[i : i + 5]).p for i in range(0, 2000, 5)]
    assert abs(np.sum(np.array(p) < 0.05) - 20) < 27


@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_a_wrong_size_of_the_innovations_is_no_correlation(scale):
    white = np.random.default_rng(4).standard_normal((100, 200, 2))
    one, other = whiteness(*sums(white)), whiteness(*sums(scale * white))
    assert other.p == pytest.approx(one.p)
    assert other.rejected == one.rejected


def test_correlated_innovations_are_found():
    rng = np.random.default_rng(5)
    white = rng.standard_normal((200, 50, 2))
    for k in range(1, 200):
        white[k] += 0.2 * white[k - 1]
    found = whiteness(*sums(white))
    assert found.p < 1e-6
    assert found.rejected.low > 0.3
    assert found.correlation[0].value == pytest.approx(0.2, abs=0.04)
    assert found.correlation[1].value == pytest.approx(0.04, abs=0.04)


def test_lags_that_never_met_do_not_count():
    white = np.random.default_rng(6).standard_normal((4, 3000, 2))  # 3 lags at most
    found = whiteness(*sums(white))
    pooled = [x.sum(axis=0)[:4] for x in sums(white)]
    assert found.p == pytest.approx(stats.chi2.sf(portmanteau(*pooled), 3))
    assert np.isnan(found.correlation[5].value)


def test_failed_runs_and_single_innovations():
    products, terms = sums(np.random.default_rng(7).standard_normal((50, 6, 2)))
    broken = products.copy()
    broken[2] = np.nan
    keep = np.arange(6) != 2
    assert whiteness(broken, terms) == whiteness(products[keep], terms[keep])
    assert module.whiteness(*sums(np.ones((1, 3, 2)))) is None
    assert module.whiteness(products[:0], terms[:0]) is None


def test_a_lag_of_one_term_counts_in_each_runs_degrees_of_freedom():
    products, terms = sums(np.random.default_rng(8).standard_normal((4, 3000, 1)))
    assert terms[0, 1:4].tolist() == [3, 2, 1]
    statistic = portmanteau(products, terms)
    refused, with_two = (int((stats.chi2.sf(statistic, dof) < 0.05).sum()) for dof in (3, 2))
    assert refused != with_two
    assert whiteness(products, terms).rejected.value == pytest.approx(refused / 3000)
