import numpy as np
import pytest

from estbench.errors import DimensionError
from estbench.estimators.beliefs import Fault
from estbench.estimators.factors import (
    FactorEstimator,
    cholesky_update,
    lost,
    noise_root,
    triangular,
    weighted_factor,
)
from tests.helpers import random_cov


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [1, 2, 7])
@pytest.mark.parametrize("weight", [1.0, 2.5, 0.0, -1.0, -0.4])
def test_rank_one_update_is_the_factor_of_the_sum(seed, n, weight):
    rng = np.random.default_rng(seed)
    cov = random_cov(rng, n, 6)
    factor = np.asarray(np.linalg.cholesky(cov), np.float64)
    v = 0.6 * (factor @ rng.standard_normal((6, n, 1)))[..., 0] / np.sqrt(n)
    white = np.linalg.solve(factor, v[..., None])[..., 0]
    v = v / np.maximum(1.0, 1.2 * np.linalg.norm(white, axis=-1))[:, None]  # stays definite
    expected = np.linalg.cholesky(cov + weight * v[:, :, None] * v[:, None, :])
    np.testing.assert_allclose(cholesky_update(factor, v, weight), expected, rtol=1e-10, atol=1e-10)


def test_rank_one_update_leaves_its_arguments_alone():
    factor, v = np.eye(2)[None], np.ones((1, 2))
    cholesky_update(factor, v)
    np.testing.assert_array_equal(factor[0], np.eye(2))
    np.testing.assert_array_equal(v, np.ones((1, 2)))


def test_an_indefinite_downdate_is_nan_in_its_own_run():
    factor = np.broadcast_to(np.eye(2), (3, 2, 2))
    v = np.array([[0.5, 0.5], [0.8, 0.7], [0.0, 0.0]])
    out = cholesky_update(factor, v, -1.0)
    assert np.isnan(out[1]).any()
    np.testing.assert_allclose(out[0] @ out[0].T, np.eye(2) - 0.25, rtol=1e-10, atol=1e-14)
    np.testing.assert_array_equal(out[2], np.eye(2))


def test_an_update_of_zero_is_its_own_factor():
    out = cholesky_update(np.zeros((1, 2, 2)), np.array([[0.0, 3.0]]))
    np.testing.assert_array_equal(out[0], np.diag([0.0, 3.0]))


def test_a_downdate_keeps_digits_near_singularity():
    eps = 1e-6
    out = cholesky_update(np.eye(1)[None], np.array([[np.sqrt(1.0 - eps**2)]]), -1.0)
    np.testing.assert_allclose(out[0, 0, 0], eps, rtol=1e-3)


@pytest.mark.parametrize("shape", [(2, 3, 3), (4, 3, 8)])
def test_triangular_has_the_same_product(shape):
    root = np.random.default_rng(0).standard_normal(shape)
    L = triangular(root)
    np.testing.assert_allclose(
        L @ np.swapaxes(L, 1, 2), root @ np.swapaxes(root, 1, 2), rtol=1e-10, atol=1e-12
    )
    assert (np.diagonal(L, axis1=1, axis2=2) >= 0).all()
    np.testing.assert_array_equal(L, np.tril(L))


@pytest.mark.parametrize("weights", [[2.0, 0.25, 0.25], [-1.0, 0.5, 0.5]])
def test_weighted_residuals_have_the_factor_of_their_sum(weights):
    rng = np.random.default_rng(0)
    residuals, noise = rng.standard_normal((4, 3, 2)), rng.standard_normal((4, 2, 2))
    residuals[:, 0] *= 0.1
    weights = np.array(weights)
    total = np.einsum("p,rpi,rpj->rij", weights, residuals, residuals) + noise @ noise.mT
    L = weighted_factor(weights, residuals, noise)
    np.testing.assert_allclose(L @ L.mT, total, rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(L, np.tril(L))


def test_a_downdate_of_a_singular_factor_in_its_range():
    factor = np.array([[[0.0, 0.0], [0.0, 2.0]]])
    out = cholesky_update(factor, np.array([[0.0, 1.2]]), -1.0)
    np.testing.assert_allclose(out[0], np.diag([0.0, 1.6]), rtol=1e-12)
    assert np.isnan(cholesky_update(factor, np.array([[0.1, 1.2]]), -1.0)).any()


def test_noise_of_what_did_not_arrive_is_one():
    R = np.array([[2.0, 1.0], [1.0, 2.0]])
    mask = np.array([[True, True], [False, True]])
    root = noise_root(R, mask, 2)
    np.testing.assert_allclose(root[0], np.linalg.cholesky(R))
    np.testing.assert_allclose(root[1], np.diag([1.0, np.sqrt(2.0)]))


def test_faults_are_told_apart():
    good, bad = np.eye(2), np.full((2, 2), np.nan)
    codes = lost(np.stack([good, bad, bad]), np.stack([good, good, bad]))
    np.testing.assert_array_equal(codes, [0, Fault.COVARIANCE, 0])


def test_a_start_of_other_shapes_is_refused():
    with pytest.raises(DimensionError, match=r"cov \(2, 2\); expected"):
        FactorEstimator().init(np.zeros((2, 2)), np.eye(2))


def test_a_start_may_be_semidefinite_but_not_indefinite():
    cov = np.stack([np.diag([1.0, 0.0]), np.diag([1.0, -1.0])])
    estimator = FactorEstimator()
    belief = estimator.init(np.zeros((2, 2)), cov)
    np.testing.assert_array_equal(belief.fault, [0, Fault.COVARIANCE])
    np.testing.assert_allclose(estimator.cov(belief)[0], cov[0], rtol=1e-10, atol=1e-14)
