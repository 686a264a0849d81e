import numpy as np
import pytest
from filterpy.kalman import SquareRootKalmanFilter

from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.estimators.sr_ekf import SquareRootEKF
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from tests.helpers import linear_model, nonlinear_model, random_cov


def textbook_ekf(model, x, P, ys, us, dt):
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        F = model.f_jacobian(x, u, dt * k, dt)
        x, P = model.f(x, u, dt * k, dt), F @ P @ F.T + model.Q
        H = model.h_jacobian(x, u, dt * (k + 1))
        S = H @ P @ H.T + model.R
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ (y - model.h(x, u, dt * (k + 1))), P - K @ S @ K.T
    return x, P


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
def test_equals_the_textbook_ekf(seed, n):
    rng = np.random.default_rng(seed)
    model = nonlinear_model(n)
    mean, cov = 0.5 * rng.standard_normal((3, n)), 0.2 * random_cov(rng, n, 3)
    ys, us = rng.standard_normal((10, 3, n // 2 + 1)), rng.standard_normal((10, 3, 1))
    estimator = SquareRootEKF(model)
    belief = estimator.init(mean, cov)
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        belief = estimator.predict(belief, u, 0.1 * k, 0.1)
        belief, _ = estimator.update(belief, y, u, 0.1 * (k + 1))
    for run in range(3):
        x, P = textbook_ekf(model, mean[run], cov[run], ys[:, run], us[:, run], 0.1)
        np.testing.assert_allclose(belief.mean[run], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimator.cov(belief)[run], P, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(belief.factor, np.tril(belief.factor))


@pytest.mark.parametrize("seed", range(3))
def test_equals_filterpy_on_a_linear_model(seed):
    rng = np.random.default_rng(seed)
    plain = linear_model(seed, 3, 2, 0)
    Q = plain.Q + 0.1 * np.eye(3)  # FilterPy needs a Cholesky factor of Q
    model = LinearModel(plain.A, plain.C, Q, plain.R)
    mean, cov = rng.standard_normal((1, 3)), random_cov(rng, 3, 1)
    peer = SquareRootKalmanFilter(3, 2)
    peer.x, peer.P, peer.F, peer.H = mean.T, cov[0], model.A, model.C
    peer.Q, peer.R = model.Q, model.R
    estimator = SquareRootEKF(model)
    belief, u = estimator.init(mean, cov), np.zeros((1, 0))
    for y in rng.standard_normal((15, 1, 2)):
        belief, _ = estimator.update(estimator.predict(belief, u, 0.0, 1.0), y, u, 1.0)
        peer.predict()
        peer.update(y.T)
        np.testing.assert_allclose(belief.mean[0], peer.x[:, 0], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[0], peer.P, rtol=1e-10, atol=1e-10)


def test_goes_on_where_the_plain_ekf_loses_its_covariance():
    """Two nearly equal, nearly exact measurements of a very uncertain state."""
    eps = 1e-9
    C = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + eps]])
    model = LinearModel(np.eye(3), C, np.zeros((3, 3)), eps**2 * np.eye(2))
    y, u = np.ones((1, 2)), np.zeros((1, 0))
    root, plain = SquareRootEKF(model), EKF(model)
    start = np.zeros((1, 3)), np.eye(3)[None]
    ours, theirs = root.init(*start), plain.init(*start)
    for _ in range(3):
        ours, _ = root.update(ours, y, u, 0.0)
        theirs, _ = plain.update(theirs, y, u, 0.0)
    assert not ours.fault.any()
    assert (np.diagonal(ours.factor, axis1=1, axis2=2) > 0).all()
    assert theirs.fault.any()


def test_an_exactly_known_state_and_no_process_noise_are_welcome():
    model = LinearModel(np.eye(2), np.eye(2), np.zeros((2, 2)), np.eye(2))
    estimator = SquareRootEKF(model)
    belief = estimator.init(np.zeros((1, 2)), np.diag([1.0, 0.0])[None])
    belief = estimator.predict(belief, np.zeros((1, 0)), 0.0, 1.0)
    belief, _ = estimator.update(belief, np.ones((1, 2)), np.zeros((1, 0)), 1.0)
    assert not belief.fault.any()
    np.testing.assert_allclose(belief.mean, [[0.5, 0.0]], rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(belief.cov[0], np.diag([0.5, 0.0]), rtol=1e-10, atol=1e-14)


def test_noise_that_is_no_covariance_is_named_in_its_own_run():
    plain = nonlinear_model(2)

    class Wrong(FunctionModel):
        def process_noise(self, x, u, t=0.0, dt=1.0):
            return np.stack([self.Q, -self.Q])

        def measurement_noise(self, t=0.0, channels=None):
            return np.stack([-self.R, self.R])

    model = Wrong(plain.f, plain.h, plain.Q, plain.R, 1, plain.f_jacobian, plain.h_jacobian)
    estimator = SquareRootEKF(model)
    start = estimator.init(np.zeros((2, 2)), np.stack([np.eye(2)] * 2))
    u, y = np.zeros((2, 1)), np.ones((2, 2))
    np.testing.assert_array_equal(
        estimator.predict(start, u, 0.0, 0.1).fault, [0, Fault.COVARIANCE]
    )
    np.testing.assert_array_equal(
        estimator.update(start, y, u, 0.0)[0].fault, [Fault.INNOVATION, 0]
    )
