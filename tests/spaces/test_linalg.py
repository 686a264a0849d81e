import numpy as np
import pytest
from scipy.linalg import solve_triangular

from estbench.spaces import linalg
from tests.helpers import random_cov

SIZES = [(1, 1), (1, 3), (5, 1), (7, 4), (4, 12)]
sizes = pytest.mark.parametrize(("runs", "n"), SIZES)


def stack(runs, n, seed=0):
    return random_cov(np.random.default_rng(seed), n, runs)


def test_symmetrize():
    a = np.random.default_rng(0).standard_normal((3, 4, 4))
    np.testing.assert_array_equal(linalg.symmetrize(a)[1], 0.5 * (a[1] + a[1].T))


@sizes
def test_cholesky_is_numpys(runs, n):
    a = stack(runs, n)
    for factor, one in zip(linalg.cholesky(a), a):
        np.testing.assert_array_equal(factor, np.linalg.cholesky(one))


@sizes
@pytest.mark.parametrize("columns", [1, 3])
def test_triangular_solves_are_scipys(runs, n, columns):
    lower = linalg.cholesky(stack(runs, n))
    b = np.random.default_rng(1).standard_normal((runs, n, columns))
    for i in range(runs):
        down = solve_triangular(lower[i], b[i], lower=True)
        np.testing.assert_allclose(linalg.solve_lower(lower, b)[i], down, rtol=1e-10, atol=1e-12)
        up = solve_triangular(lower[i].T, b[i], lower=False)
        out = linalg.solve_lower_transposed(lower, b)[i]
        np.testing.assert_allclose(out, up, rtol=1e-10, atol=1e-12)


@sizes
def test_quadratic_form(runs, n):
    a = stack(runs, n)
    v = np.random.default_rng(2).standard_normal((runs, n))
    expected = [one @ np.linalg.inv(p) @ one for p, one in zip(a, v)]
    np.testing.assert_allclose(linalg.quadratic_form(a, v), expected, rtol=1e-9)


BAD = {
    "indefinite": np.diag([1.0, -1.0, 1.0]),
    "singular": np.diag([1.0, 0.0, 1.0]),
    "nan": np.full((3, 3), np.nan),
    "one nan": np.diag([1.0, 1.0, np.nan]),
    "inf": np.diag([1.0, np.inf, 1.0]),
}


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("places", [[0], [6], [2, 3], range(7)])
def test_a_bad_matrix_spoils_only_its_own_row(bad, places):
    a, v = stack(7, 3), np.random.default_rng(3).standard_normal((7, 3))
    b = v[..., None]
    a[list(places)] = BAD[bad]
    factor, form = linalg.cholesky(a), linalg.quadratic_form(a, v)
    down, up = linalg.solve_lower(factor, b), linalg.solve_lower_transposed(factor, b)
    for i in range(7):
        if i in places:
            assert np.isnan(factor[i]).all()
            assert np.isnan(form[i])
            continue
        alone = linalg.cholesky(a[i : i + 1])
        np.testing.assert_array_equal(factor[i], alone[0])
        np.testing.assert_array_equal(down[i], linalg.solve_lower(alone, b[i : i + 1])[0])
        np.testing.assert_array_equal(up[i], linalg.solve_lower_transposed(alone, b[i : i + 1])[0])
        assert form[i] == linalg.quadratic_form(a[i : i + 1], v[i : i + 1])[0]


def test_several_kinds_of_failure_in_one_stack():
    a = np.concatenate([stack(3, 3), np.stack(list(BAD.values())), stack(2, 3, seed=4)])
    finite = np.isfinite(linalg.cholesky(a)).all(axis=(-2, -1))
    assert finite.tolist() == [True] * 3 + [False] * len(BAD) + [True] * 2


def test_the_input_is_left_alone():
    a = np.concatenate([stack(2, 3), BAD["nan"][None], BAD["indefinite"][None]])
    before = a.copy()
    linalg.cholesky(a)
    np.testing.assert_array_equal(a, before)


@pytest.mark.parametrize("rank", [0, 1, 2, 4])
def test_psd_factor_of_singular_matrices(rank):
    g = np.random.default_rng(rank).standard_normal((4, rank))
    factor = linalg.psd_factor(g @ g.T)
    assert factor.shape == (4, 4)
    np.testing.assert_allclose(factor @ factor.T, g @ g.T, atol=1e-12)


def test_psd_factor_of_rounding_below_zero():
    factor = linalg.psd_factor(np.diag([1.0, -1e-18]))
    assert np.isfinite(factor).all()
    np.testing.assert_allclose(factor @ factor.T, np.diag([1.0, 0.0]), atol=1e-15)


def test_is_positive_definite():
    good = stack(1, 3)[0]
    assert linalg.is_positive_definite(good)
    assert not linalg.is_positive_definite(good + np.triu(np.full((3, 3), 0.1), 1))
    for bad in BAD.values():
        assert not linalg.is_positive_definite(bad)
