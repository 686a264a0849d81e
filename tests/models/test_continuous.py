import numpy as np
import pytest
from scipy.linalg import expm

from estbench.errors import CovarianceError, DimensionError
from estbench.models.continuous import (
    ContinuousFunctionModel,
    ContinuousModel,
    integrate_moments,
)
from estbench.models.differences import Differences
from estbench.models.noise import scheduled, van_loan
from estbench.models.protocol import Model
from tests.helpers import random_cov

CENTERED = Differences("centered", 1e-5)


def pendulum(**settings):
    options = {"G": np.array([[0.0], [1.0]]), "Q_s": np.diag([0.0, 0.1]), **settings}
    return ContinuousFunctionModel(
        lambda x, u, t: np.stack([x[..., 1], -np.sin(x[..., 0]) - 0.1 * x[..., 1]], axis=-1),
        lambda x, u, t: np.sin(x[..., :1]) + 0.3 * u[..., :1],
        R=0.01 * np.eye(1),
        **options,
    )


def linear(seed, n=3, substeps=1):
    rng = np.random.default_rng(seed)
    F, G = rng.standard_normal((n, n)), rng.standard_normal((n, 2))
    model = ContinuousFunctionModel(
        lambda x, u, t: x @ F.T, lambda x, u, t: x[..., :1], random_cov(rng, n), np.eye(1), G,
        f_jacobian=lambda x, u, t: F, substeps=substeps,
    )  # fmt: skip
    return model, F, G


def test_it_is_a_model_and_a_continuous_model():
    assert isinstance(pendulum(), Model)
    assert isinstance(pendulum(), ContinuousModel)
    assert pendulum().nu == 1


@pytest.mark.parametrize("seed", range(3))
def test_a_linear_model_converges_to_its_exact_discretization_with_order_four(seed):
    rng = np.random.default_rng(seed)
    x, u, dt = rng.standard_normal((2, 3)), rng.standard_normal((2, 2)), 0.4
    errors = []
    for substeps in (2, 4, 8, 16):
        model, F, G = linear(seed, substeps=substeps)
        Phi, Q = van_loan(F, model.spectral_density(x, u), dt)
        augmented = expm(np.block([[F, G], [np.zeros((2, 5))]]) * dt)
        end = x @ augmented[:3, :3].T + u @ augmented[:3, 3:].T
        ours, our_Phi = model.transition_jacobian(x, u, 0.0, dt)
        our_Q = model.process_noise(x, u, 0.0, dt)
        pairs = ((ours, end), (our_Phi, Phi), (our_Q, Q))
        errors.append([np.abs(a - b).max() for a, b in pairs])
    rate = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (rate[-1] > 3.7).all()
    assert max(errors[-1]) < 1e-4


@pytest.mark.parametrize("substeps", [1, 3])
def test_transition_jacobian_is_the_derivative_of_the_transition(substeps):
    model = pendulum(substeps=substeps)
    rng = np.random.default_rng(0)
    x, u = rng.standard_normal((4, 2)), rng.standard_normal((4, 1))
    value, Phi = model.transition_jacobian(x, u, 0.0, 0.2)
    expected, slope = CENTERED.jacobian(
        lambda p: model.transition(p, u, 0.0, 0.2), model.space, model.space, x
    )
    np.testing.assert_allclose(value, expected, atol=1e-14)
    np.testing.assert_allclose(Phi, slope, atol=1e-8)


def test_points_are_moved_like_single_states():
    model = pendulum()
    rng = np.random.default_rng(1)
    points, u = rng.standard_normal((3, 5, 2)), rng.standard_normal((3, 1))
    together = model.transition(points, u, 0.0, 0.1)
    for k in range(5):
        np.testing.assert_array_equal(together[:, k], model.transition(points[:, k], u, 0.0, 0.1))


def test_a_function_of_one_state_is_looped_over():
    one = ContinuousFunctionModel(
        lambda x, u, t: np.array([x[1], -np.sin(x[0]) - 0.1 * x[1] + u[0]]),
        lambda x, u, t: np.array([np.sin(x[0]) + 0.3 * u[0]]),
        np.diag([0.0, 0.1]), 0.01 * np.eye(1), n_controls=1, batched=False,
    )  # fmt: skip
    rng = np.random.default_rng(2)
    x, u = rng.standard_normal((3, 2)), rng.standard_normal((3, 1))
    for ours, theirs in zip(
        one.transition_jacobian(x, u, 0.0, 0.1), pendulum().transition_jacobian(x, u, 0.0, 0.1),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(ours, theirs, atol=1e-14)
    for ours, theirs in zip(
        one.measurement_jacobian(x, u), pendulum().measurement_jacobian(x, u), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_time_varying_matrices():
    zero = np.zeros((2, 2))
    model = pendulum(
        Q_s=scheduled([0.0, 1.0], [zero, np.eye(2)]), G=lambda t: np.array([[t], [2 * t]])
    )
    x, u = np.zeros((1, 2)), np.ones((1, 1))
    np.testing.assert_array_equal(model.process_noise(x, u, 0.0, 0.5), np.zeros((1, 2, 2)))
    assert (np.linalg.eigvalsh(model.process_noise(x, u, 1.0, 0.5)) > 0).all()
    np.testing.assert_allclose(model.flow(x, u, 3.0), [[3.0, 6.0]])


def test_noise_and_control_matrices_are_checked():
    with pytest.raises(DimensionError, match="G has shape"):
        pendulum(G=np.ones((3, 1)))
    with pytest.raises(DimensionError, match="G has shape"):
        pendulum(n_controls=2)
    with pytest.raises(DimensionError, match=r"G has shape \(\)"):
        pendulum(G=1.0)
    with pytest.raises(DimensionError, match="substeps is 0"):
        pendulum(substeps=0)
    with pytest.raises(DimensionError, match=r"Q_s has shape \(\); expected a square matrix"):
        ContinuousFunctionModel(lambda x, u, t: x, lambda x, u, t: x, 0.1, np.eye(1))
    with pytest.raises(CovarianceError, match="R is not"):
        ContinuousFunctionModel(lambda x, u, t: x, lambda x, u, t: x, np.eye(2), -np.eye(2))
    short = ContinuousFunctionModel(
        lambda x, u, t: x[..., :1], lambda x, u, t: x, np.eye(2), np.eye(2)
    )
    with pytest.raises(DimensionError, match="f returned shape"):
        short.transition(np.zeros((1, 2)), np.zeros((1, 0)), 0.0, 0.1)


def test_a_run_that_is_not_finite_leaves_the_others_alone():
    model = pendulum()
    x, u = np.array([[0.1, 0.2], [np.nan, 0.0], [0.3, 0.4]]), np.zeros((3, 1))
    ours = integrate_moments(model, x, u, 0.0, 0.1)
    alone = integrate_moments(model, x[[0, 2]], u[[0, 2]], 0.0, 0.1)
    for whole, part in zip(ours, alone, strict=True):
        np.testing.assert_array_equal(whole[[0, 2]], part)
        assert np.isnan(whole[1]).any()
