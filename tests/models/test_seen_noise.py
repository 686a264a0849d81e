"""Process noise that the sensors see, against the Kalman filter with correlated noise."""

from dataclasses import dataclass

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.estimators.protocol import Estimator
from estbench.models.differences import Differences
from estbench.models.seen_noise import DisturbedModel, SeenNoise
from estbench.spaces.manifold import Manifold

DT = 0.1
A = np.array([[1.0, DT, 0.0], [-0.3 * DT, 1.0 - 0.1 * DT, DT], [0.0, 0.0, 0.9]])
B = np.array([[0.0], [DT], [0.1]])
GAIN = np.array([[0.5 * DT**2, 0.0], [DT, 0.0], [0.02, 0.3]])  # Γ
ROOT = np.array([[2.0, 0.0], [0.4, 0.7]])  # D
C = np.array([[1.0, 0.0, 0.0], [-0.3, -0.1, 1.0]])
E = np.array([[0.0, 0.0], [1.0, 0.5]])  # only the second reading sees the disturbance
R = np.diag([0.04, 0.01])
STEPS, RUNS = 30, 3
EXACT = ["kf", "lkf", "ekf", "sr_ekf", "iekf", "ukf", "sr_ukf", "ckf", "ghkf"]


@dataclass(frozen=True)
class Accelerometer:
    """x⁺ = A x + B u + Γ w, y = C x + E D w + v, of which `position` does not see w."""

    differences = Differences("centered", 1e-2)  # exact for a linear function, up to rounding
    disturbances = Manifold.euclidean(2)
    space = Manifold.euclidean(3)
    nu = 1

    def _rows(self, channels):
        return [0, 1] if channels is None else [["position", "accel"].index(c) for c in channels]

    def output(self, channels=None):
        return Manifold.euclidean(len(self._rows(channels)))

    def transition(self, x, u, t, dt):
        return x @ A.T + (u @ B.T if x.ndim == 2 else (u @ B.T)[:, None])

    def transition_jacobian(self, x, u, t, dt):
        return self.transition(x, u, t, dt), np.broadcast_to(A, (len(x), 3, 3))

    def process_noise(self, x, u, t, dt):
        return GAIN @ GAIN.T

    def measurement(self, x, u, t, channels=None):
        return x @ C[self._rows(channels)].T

    def measurement_jacobian(self, x, u, t, channels=None):
        rows = C[self._rows(channels)]
        return x @ rows.T, np.broadcast_to(rows, (len(x), *rows.shape))

    def measurement_noise(self, t, channels=None):
        rows = self._rows(channels)
        return R[rows][:, rows]

    def sees_disturbance(self, channels=None):
        return 1 in self._rows(channels)

    def disturbance_gain(self, x, u, t, dt):
        return np.broadcast_to(GAIN, (len(x), 3, 2)), ROOT

    def disturbed_measurement(self, x, d, u, t, channels=None):
        return self.measurement(x, u, t, channels) + d @ E[self._rows(channels)].T


def correlated(x, P, y, u):
    """One step of the Kalman filter with S = E[Γ w (E D w + v)ᵀ] (Simon 2006, eq. 7.14)."""
    x, P = A @ x + B @ u, A @ P @ A.T + GAIN @ GAIN.T
    M, noise = GAIN @ (E @ ROOT).T, E @ ROOT @ (E @ ROOT).T + R
    S = C @ P @ C.T + C @ M + M.T @ C.T + noise
    K = np.linalg.solve(S, (P @ C.T + M).T).T
    v = y - C @ x
    return x + K @ v, P - K @ S @ K.T, v @ np.linalg.solve(S, v)


def driven(name):
    rng = np.random.default_rng(3)
    model = SeenNoise(Accelerometer())
    estimator = registry.create(name, {}, model)
    assert isinstance(estimator, Estimator)
    mean, cov = rng.standard_normal((RUNS, 3)), np.tile(np.diag([1.0, 2.0, 0.5]), (RUNS, 1, 1))
    belief = estimator.init(*model.augment(mean, cov))
    ys, us = rng.standard_normal((STEPS, RUNS, 2)), rng.standard_normal((STEPS, RUNS, 1))
    for k, (y, u) in enumerate(zip(ys, us)):
        belief = estimator.predict(belief, u, k * DT, DT)
        belief, innovation = estimator.update(belief, y, u, (k + 1) * DT)
        yield mean, cov, y, u, estimator.mean(belief), estimator.cov(belief), innovation


@pytest.mark.parametrize("name", EXACT)
def test_it_is_the_kalman_filter_with_correlated_noise(name):
    """Mean, P and NIS of 30 steps, to 1e-10."""
    exact = None
    for mean, cov, y, u, found, P, innovation in driven(name):
        exact = [(m, c, 0.0) for m, c in zip(mean, cov)] if exact is None else exact
        exact = [correlated(m, c, y[i], u[i]) for i, (m, c, _) in enumerate(exact)]
        for i, (m, c, nis) in enumerate(exact):
            np.testing.assert_allclose(found[i, :3], m, rtol=0, atol=1e-10)
            np.testing.assert_allclose(P[i, :3, :3], c, rtol=0, atol=1e-10)
            np.testing.assert_allclose(innovation.nis[i], nis, rtol=1e-9)


def test_channels_that_do_not_see_it_have_no_slope_on_it():
    model = SeenNoise(Accelerometer())
    assert isinstance(model.model, DisturbedModel)
    x = np.random.default_rng(0).standard_normal((2, 5))
    y, H = model.measurement_jacobian(x, np.zeros((2, 1)), 0.0, ["position"])
    np.testing.assert_array_equal(H[0], [[1.0, 0, 0, 0, 0]])
    np.testing.assert_array_equal(y, model.measurement(x, np.zeros((2, 1)), 0.0, ["position"]))
    _, H = model.measurement_jacobian(x, np.zeros((2, 1)), 0.0)
    np.testing.assert_allclose(H[1], np.concatenate([C, E], axis=1), atol=1e-12)


def test_without_the_cross_covariance_the_filter_is_another():
    """What the test above would not see: S = 0 changes the mean by more than 1e-3."""
    mean, cov, y, u, found, _, _ = next(driven("ekf"))
    P = A @ cov[0] @ A.T + GAIN @ GAIN.T
    S = C @ P @ C.T + E @ ROOT @ (E @ ROOT).T + R
    x = A @ mean[0] + B @ u[0]
    ignorant = x + P @ C.T @ np.linalg.solve(S, y[0] - C @ x)
    assert np.abs(ignorant - found[0, :3]).max() > 1e-3
