import math

import numpy as np
import pytest

from estbench.errors import CovarianceError, DimensionError
from estbench.estimators.ekf import EKF
from estbench.models.function import FunctionModel
from estbench.models.protocol import Model
from tests.helpers import nonlinear_model

DT = 0.1
dimensions = pytest.mark.parametrize("n", [2, 4, 6])


def inputs(n, runs=3, points=None):
    rng = np.random.default_rng(n)
    lead = (runs,) if points is None else (runs, points)
    return rng.standard_normal((*lead, n)), rng.standard_normal((runs, 1))


def scalar_model(f=None, h=None, Q=np.eye(2), R=np.eye(2), **options):  # noqa: B008 not changed
    def identity(x, u, *time):
        return x

    return FunctionModel(f or identity, h or identity, Q, R, **options)


@dimensions
def test_batched_and_looped_functions_agree(n):
    batched, looped = nonlinear_model(n), nonlinear_model(n, batched=False)
    for points in (None, 4):
        x, u = inputs(n, points=points)
        for name, time in (("transition", (0.0, DT)), ("measurement", (0.0,))):
            a, b = (getattr(model, name)(x, u, *time) for model in (batched, looped))
            np.testing.assert_allclose(a, b, atol=1e-14)
            assert a.shape[:-1] == x.shape[:-1]
    x, u = inputs(n)
    F = [model.transition_jacobian(x, u, 0.0, DT)[1] for model in (batched, looped)]
    np.testing.assert_allclose(*F, atol=1e-14)


@dimensions
@pytest.mark.parametrize("batched", [True, False])
def test_difference_jacobians_agree_with_the_users(n, batched):
    exact, differenced = nonlinear_model(n), nonlinear_model(n, jacobians=False, batched=batched)
    x, u = inputs(n)
    for name, time in (("transition_jacobian", (0.0, DT)), ("measurement_jacobian", (0.0,))):
        (value, J), (other, slope) = (getattr(m, name)(x, u, *time) for m in (exact, differenced))
        np.testing.assert_allclose(other, value, atol=1e-14)
        np.testing.assert_allclose(slope, J, atol=1e-9)


def test_points_see_their_runs_control():
    model = nonlinear_model(4)
    x, u = inputs(4, points=5)
    moved = model.measurement(x, u, 0.0) - model.measurement(x, 0 * u, 0.0)
    np.testing.assert_allclose(moved[..., 0], np.repeat(0.2 * u, 5, axis=1), atol=1e-14)


def test_time_reaches_the_functions():
    model = scalar_model(f=lambda x, u, t, dt: x + 10 * t + dt, h=lambda x, u, t: x * t)
    x, u = np.ones((1, 2)), np.zeros((1, 0))
    np.testing.assert_allclose(model.transition(x, u, 2.0, 0.5), 21.5)
    np.testing.assert_allclose(model.measurement(x, u, 3.0), 3.0)
    np.testing.assert_allclose(
        model.measurement_jacobian(x, u, 3.0)[1][0], 3 * np.eye(2), atol=1e-9
    )


def test_a_constant_jacobian_is_for_every_run():
    J = np.array([[1.0, 2.0], [3.0, 4.0]])
    model = scalar_model(f_jacobian=lambda *_: J, h_jacobian=lambda *_: 2 * J)
    x, u = np.zeros((3, 2)), np.zeros((3, 0))
    np.testing.assert_array_equal(model.transition_jacobian(x, u, 0.0, DT)[1], [J] * 3)
    np.testing.assert_array_equal(model.measurement_jacobian(x, u)[1], [2 * J] * 3)


def test_what_it_is():
    model = scalar_model(names=("a", "b"), units=("m", "m/s"), n_controls=2)
    assert isinstance(model, Model)
    assert model.space.names == ("a", "b")
    assert model.space.units == ("m", "m/s")
    assert (model.nu, model.output().n) == (2, 2)
    np.testing.assert_array_equal(
        model.process_noise(np.zeros((1, 2)), np.zeros((1, 2))), np.eye(2)
    )
    np.testing.assert_array_equal(model.measurement_noise(), np.eye(2))


@pytest.mark.parametrize(
    ("broken", "call", "name"),
    [
        ({"f": lambda x, u, t, dt: x[..., :1]}, "transition", "f"),
        ({"h": lambda x, u, t: x[..., 0]}, "measurement", "h"),
        ({"f_jacobian": lambda *_: np.eye(3)}, "transition_jacobian", "f_jacobian"),
        ({"h_jacobian": lambda *_: np.ones((1, 2))}, "measurement_jacobian", "h_jacobian"),
    ],
)
def test_a_wrong_shape_names_the_function(broken, call, name):
    time = (0.0, DT) if call.startswith("transition") else (0.0,)
    with pytest.raises(DimensionError, match=rf"^{name} returned shape \(.*; expected \(3, 2"):
        getattr(scalar_model(**broken), call)(np.zeros((3, 2)), np.zeros((3, 0)), *time)


def test_a_function_for_one_state_says_how_to_declare_it():
    model = scalar_model(f=lambda x, u, t, dt: np.array([x[0], x[1]]))
    with pytest.raises(DimensionError, match="batched=False"):
        model.transition(np.zeros((3, 2)), np.zeros((3, 0)))


def test_a_function_asked_for_points_is_told_what_they_are():
    model = scalar_model(f=lambda x, u, t, dt: x[..., 0], Q=np.eye(1), R=np.eye(1))
    with pytest.raises(DimensionError, match=r"x of shape \(4, 3, 1\) = \(run, point, n\): sev"):
        model.transition_jacobian(np.zeros((4, 1)), np.zeros((4, 0)))


@pytest.mark.parametrize("Q", [-np.eye(2), [[1.0, 0.5], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]]])
def test_Q_must_be_positive_semidefinite(Q):
    for given in (np.array(Q), lambda t, dt: np.array(Q)):
        with pytest.raises(CovarianceError, match="Q is not symmetric positive semidefinite"):
            scalar_model(Q=given)
    assert scalar_model(Q=np.zeros((2, 2))).space.n == 2


def test_R_must_be_positive_definite():
    with pytest.raises(CovarianceError, match="R is not"):
        FunctionModel(lambda *a: a[0], lambda *a: a[0], np.eye(2), np.diag([1.0, 0.0]))


@pytest.mark.parametrize("batched", [True, False])
def test_process_noise_enters_through_omega_at_the_estimate(batched):
    """x⁺ = f(x) + Ω(x) w: the EKF's P⁻ is Φ P Φᵀ + Ω Q Ωᵀ (source 002), by hand, run by run."""

    def gain(x, u, t, dt):
        return dt * np.stack([np.stack([x[..., 1], 1.0 + 0 * x[..., 0]], axis=-1)], axis=-1)

    def f(x, u, t, dt):
        return np.stack([x[..., 0] + dt * x[..., 1], x[..., 1] - dt * np.sin(x[..., 0])], axis=-1)

    def h(x, u, t):
        return x[..., :1]

    model = FunctionModel(
        f, h, 0.3 * np.eye(1), np.eye(1), batched=batched, noise_gain=gain, n_states=2
    )
    x, u, dt = inputs(2)[0], np.zeros((3, 0)), 0.2
    P = np.tile(np.diag([0.5, 0.2]), (3, 1, 1))
    ekf = EKF(model)
    belief = ekf.predict(ekf.init(x, P), u, 0.0, dt)
    for i in range(3):
        F = np.array([[1.0, dt], [-dt * np.cos(x[i, 0]), 1.0]])
        Omega = dt * np.array([[x[i, 1]], [1.0]])
        expected = F @ P[i] @ F.T + 0.3 * Omega @ Omega.T
        np.testing.assert_allclose(belief.cov[i], expected, atol=1e-8)


def test_a_constant_omega_is_that_of_the_covariance_itself():
    Omega = np.array([[1.0, 0.5], [0.0, 2.0], [1.0, 1.0]])
    model = FunctionModel(
        lambda x, *_: x, lambda x, *_: x, np.diag([2.0, 3.0]), np.eye(3), noise_gain=Omega
    )
    assert model.space.n == 3
    expected = Omega @ np.diag([2.0, 3.0]) @ Omega.T
    np.testing.assert_array_equal(model.process_noise(np.zeros((1, 3)), np.zeros((1, 0))), expected)


def test_noise_may_depend_on_time():
    model = FunctionModel(
        lambda x, *_: x, lambda x, *_: x, lambda t, dt: dt * (1.0 + t) * np.eye(2),
        lambda t: np.diag([1.0, 4.0 + t]),
    )  # fmt: skip
    ekf, u = EKF(model), np.zeros((1, 0))
    belief = ekf.init(np.zeros((1, 2)), np.eye(2)[None])
    prior = ekf.predict(belief, u, 2.0, 0.5)
    np.testing.assert_allclose(prior.cov[0], (1.0 + 1.5) * np.eye(2), rtol=1e-8)
    _, innovation = ekf.update(prior, np.zeros((1, 2)), u, 2.5)
    np.testing.assert_allclose(innovation.cov[0], np.diag([3.5, 9.0]), rtol=1e-8)


def test_a_function_of_one_state_may_return_lists_and_numbers():
    """A published example as it is written: a falling body, its height seen through a sine."""
    model = FunctionModel(
        lambda x, u, t, dt: [x[0] + dt * x[1], x[1] - 9.81 * dt],
        lambda x, u, t: math.sin(x[0]),
        0.1 * np.eye(2),
        np.eye(1),
        batched=False,
    )
    x, u = inputs(2, points=4)
    np.testing.assert_allclose(model.transition(x, u, 0.0, 0.1)[..., 1], x[..., 1] - 0.981)
    np.testing.assert_allclose(model.measurement(x, u)[..., 0], np.sin(x[..., 0]))
    _, H = model.measurement_jacobian(x[:, 0], u)
    np.testing.assert_allclose(H[:, 0, 0], np.cos(x[:, 0, 0]), atol=1e-9)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ({"Q": 0.1}, r"Q has shape \(\); expected a square matrix, 0.1 \* np.eye\(1\)"),
        ({"n_states": 3}, r"Q has shape \(2, 2\); expected \(3, 3\) for 3 states"),
        (
            {"n_states": 2, "noise_gain": np.ones((3, 2))},
            r"noise_gain has shape \(3, 2\); expected \(2, 2\) for 2 states",
        ),
        ({"R": np.ones(2)}, r"R has shape \(2,\); expected a square matrix"),
        ({"Q": lambda t, dt: np.eye(2 if t == 0 else 3)}, r"Q returned shape \(3, 3\); expected"),
        ({"R": lambda t: np.eye(2 if t == 0 else 3)}, r"R returned shape \(3, 3\); expected"),
    ],
)
def test_noise_of_a_wrong_shape(noise, message):
    def use():
        model = scalar_model(**noise)
        model.process_noise(np.zeros((1, 2)), np.zeros((1, 0)), 1.0)
        model.measurement_noise(1.0)

    with pytest.raises(DimensionError, match=message):
        use()
