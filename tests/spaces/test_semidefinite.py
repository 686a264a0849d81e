import numpy as np
import pytest

from estbench.spaces.linalg import cholesky, quadratic_form
from estbench.spaces.semidefinite import (
    RESOLUTION,
    eigen_root,
    psd_root,
    range_form,
    range_root,
)
from tests.helpers import random_cov

NOTHING = np.zeros((1, 3))


def low_rank(rank, n=4, seed=0):
    g = np.random.default_rng(seed + rank).standard_normal((n, rank))
    return g @ g.T


@pytest.mark.parametrize("rank", [0, 1, 2, 4])
def test_root_by_eigenvalues_of_singular_matrices(rank):
    factor, values = eigen_root(low_rank(rank))
    assert factor.shape == (4, 4)
    np.testing.assert_allclose(factor @ factor.T, low_rank(rank), atol=1e-12)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(low_rank(rank)), atol=1e-12)


def test_root_by_eigenvalues_of_rounding_below_zero():
    factor, _ = eigen_root(np.diag([1.0, -1e-18]))
    np.testing.assert_allclose(factor @ factor.T, np.diag([1.0, 0.0]), atol=1e-15)


def test_the_root_of_a_definite_matrix_is_its_cholesky_factor_beside_singular_ones():
    definite = random_cov(np.random.default_rng(0), 4, 3)
    stack = np.concatenate([definite, [low_rank(2), np.zeros((4, 4))]])
    np.testing.assert_array_equal(psd_root(stack)[:3], cholesky(definite))
    root = psd_root(stack)
    np.testing.assert_allclose(root @ root.mT, stack, atol=1e-12)
    np.testing.assert_array_equal(psd_root(low_rank(2)), psd_root(low_rank(2)[None])[0])


def test_the_root_has_digits_in_every_unit():
    unit = np.array([1e8, 1e-7, 1.0, 1e-20])
    cov = low_rank(2) * unit[:, None] * unit
    root = psd_root(cov)
    scale = np.outer(np.sqrt(np.diag(cov)), np.sqrt(np.diag(cov)))
    np.testing.assert_allclose(root @ root.T / scale, cov / scale, atol=1e-13)


def test_the_root_of_what_is_no_covariance_is_nan():
    bad = [
        np.diag([1.0, -1e-3, 1.0]),
        np.diag([1e12, -1.0, 1.0]),  # metres and radians: below zero, whatever the scale
        np.array([[0.0, 0.1, 0.0], [0.1, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.full((3, 3), np.nan),
        np.diag([1.0, np.inf, 1.0]),
    ]
    assert np.isnan(psd_root(np.stack(bad))).any(axis=(1, 2)).all()


def test_a_difference_of_large_numbers_may_be_below_zero_by_their_rounding():
    cov = np.diag([1e8, 1e8, -1e-8])
    np.testing.assert_allclose(psd_root(cov) @ psd_root(cov).T, np.diag([1e8, 1e8, 0.0]), atol=1e-7)
    form = range_form(cov[None], np.array([[1e4, 0.0, 1e-4]]), NOTHING)
    assert form.dof[0] == 2
    assert form.value[0] == pytest.approx(1.0)


def test_rounding_errors_are_no_range():
    cov = np.array([[1.0, 1.0], [1.0, 1.0 + 2e-16]])  # with a Cholesky factor
    assert (cholesky(cov[None])[0, 1, 1]) > 0
    root = range_root(cov[None])[0]
    assert np.linalg.matrix_rank(root, 1e-12) == 1
    np.testing.assert_allclose(root @ root.T, cov, atol=1e-14)


@pytest.mark.parametrize("rank", [1, 2, 3, 4])
def test_the_quadratic_form_is_that_of_the_pseudo_inverse(rank):
    cov, rng = low_rank(rank), np.random.default_rng(9)
    v = psd_root(cov) @ rng.standard_normal(4)
    form = range_form(cov[None], v[None], np.zeros((1, 4)))
    assert form.dof[0] == rank
    assert form.value[0] == pytest.approx(v @ np.linalg.pinv(cov, 1e-10) @ v, rel=1e-8)
    unit = np.array([1e8, 1e-7, 1.0, 1e-20])
    other = range_form((cov * unit[:, None] * unit)[None], (v * unit)[None], np.zeros((1, 4)))
    assert other.dof[0] == rank
    assert other.value[0] == pytest.approx(form.value[0], rel=1e-8)


def test_definite_rows_are_those_of_the_cholesky_factor_to_the_bit():
    rng = np.random.default_rng(0)
    cov, v = random_cov(rng, 3, 5), rng.standard_normal((5, 3))
    mixed = cov.copy()
    mixed[2] = 0.0
    form = range_form(mixed, v, np.zeros((5, 3)))
    good = np.arange(5) != 2
    np.testing.assert_array_equal(form.value[good], quadratic_form(cov[good], v[good]))
    np.testing.assert_array_equal(form.dof, [3, 3, 0, 3, 3])
    np.testing.assert_array_equal(form.known, ~good[:, None] & np.ones((5, 3), bool))


def test_what_is_known_exactly_counts_nothing_while_the_error_is_a_rounding_error():
    cov = np.diag([4.0, 0.0, 1e-40])[None]  # σ of the last is 1e-20
    size = np.array([[1.0, 0.3, 0.3]])
    v = np.array([[2.0, 2 * RESOLUTION * 0.3, -RESOLUTION * 0.3]])
    form = range_form(cov, v, RESOLUTION * size)
    assert form.dof[0] == 1
    assert form.value[0] == 1.0
    np.testing.assert_array_equal(form.known, [[False, True, True]])


@pytest.mark.parametrize("place", [1, 2])
def test_what_is_known_exactly_and_wrong_is_as_inconsistent_as_numbers_can_tell(place):
    cov = np.diag([4.0, 0.0, 1e-40])[None]
    v = np.array([[2.0, 0.0, 0.0]])
    v[0, place] = 1e-9
    form = range_form(cov, v, np.full((1, 3), RESOLUTION))
    assert form.value[0] == pytest.approx((1e-9 / RESOLUTION) ** 2, rel=1e-6)
    assert form.dof[0] == 1


def test_an_error_outside_of_the_range_is_not_dropped():
    cov = np.array([[1.0, 1.0], [1.0, 1.0]])[None]  # x0 = x1
    inside, outside = (np.array([[1.0, x]]) for x in (1.0, 1.001))
    none, nearly = np.zeros((1, 2)), np.array([[1.0 + 1e-8, 1.0]])
    assert range_form(cov, inside, none).value[0] == pytest.approx(1.0)
    assert range_form(cov, outside, none).value[0] > 1e6
    assert range_form(cov, nearly, none).value[0] == pytest.approx(1.0, abs=1e-6)


def test_no_number_for_what_is_no_covariance():
    lopsided = np.diag([1.0, 0.0, 1.0])
    lopsided[0, 2] = 0.1
    bad = [
        np.diag([1.0, -1e-3, 0.0]),
        lopsided,
        np.full((3, 3), np.nan),
        np.diag([1e12, -1.0, 1.0]),
    ]
    form = range_form(np.stack(bad), np.ones((4, 3)), np.zeros((4, 3)))
    assert np.isnan(form.value).all()
