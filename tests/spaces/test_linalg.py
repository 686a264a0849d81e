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
        one = linalg.solve_one_lower(lower[i], b[i])
        np.testing.assert_allclose(one, down, rtol=1e-10, atol=1e-12)
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


def test_is_positive_definite():
    good = stack(1, 3)[0]
    assert linalg.is_positive_definite(good)
    rounding = np.triu(good, 1) * 1e-12
    assert linalg.is_positive_definite(good + rounding)
    assert not linalg.is_positive_definite(good + 1e4 * rounding)
    assert not linalg.is_positive_definite(good + np.triu(np.full((3, 3), 0.1), 1))
    for bad in BAD.values():
        assert not linalg.is_positive_definite(bad)


def test_is_positive_semidefinite():
    good = stack(1, 3)[0]
    for matrix in (good, BAD["singular"], np.zeros((2, 2)), np.zeros((0, 0))):
        assert linalg.is_positive_semidefinite(matrix)
    assert linalg.is_positive_semidefinite(np.diag([1.0, -1e-13]))  # rounding
    assert linalg.is_positive_semidefinite(np.diag([1e4, -1e-9]))  # relative to the largest entry
    assert not linalg.is_positive_semidefinite(np.diag([1.0, -1e-11]))
    assert not linalg.is_positive_semidefinite(good + np.triu(np.full((3, 3), 0.1), 1))
    for name in ("indefinite", "nan", "one nan", "inf"):
        assert not linalg.is_positive_semidefinite(BAD[name])


def test_what_did_not_arrive_is_uncorrelated_with_unit_variance():
    a = stack(3, 3)
    mask = np.array([[True, False, True], [False, False, False], [True, True, True]])
    for cov in (a, a[0]):
        out = linalg.pad_absent(cov, mask)
        for i in range(3):
            expected = np.eye(3)
            rows = np.ix_(mask[i], mask[i])
            expected[rows] = np.broadcast_to(cov, (3, 3, 3))[i][rows]
            np.testing.assert_array_equal(out[i], expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("size", [3, 4095, 4096, 5000])
def test_surely_finite_finds_every_bad_number(size, value):
    good = np.ones(size)
    bad = good.copy()
    bad[-1] = value
    assert linalg.surely_finite(good, good)
    assert not linalg.surely_finite(good, bad)
    assert not linalg.surely_finite(bad, good)


def test_weighted_sums():
    rng = np.random.default_rng(0)
    points, weights = rng.standard_normal((4, 5, 2)), rng.uniform(size=(4, 5))
    each = np.einsum("rp,rpk->rk", weights, points)
    np.testing.assert_allclose(linalg.weighted(weights, points), each, rtol=1e-12)
    shared = np.einsum("p,rpk->rk", weights[0], points)
    np.testing.assert_allclose(linalg.weighted(weights[0], points), shared, rtol=1e-12)


def test_rescaled():
    a, d = stack(1, 3)[0], np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(linalg.rescaled(a, 2.0), 4.0 * a)
    np.testing.assert_allclose(linalg.rescaled(a, d), np.diag(d) @ a @ np.diag(d))
    np.testing.assert_array_equal(linalg.rescaled(a, np.eye(3)), np.eye(3))


def test_the_identity_is_shared_and_read_only():
    np.testing.assert_array_equal(linalg.identity(3), np.eye(3))
    assert linalg.identity(3) is linalg.identity(3)
    with pytest.raises(ValueError, match="read-only"):
        linalg.identity(3)[0, 0] = 2.0
