"""A filter of your own: `estbench run pendulum -e ekf -e examples.my_filter:MyFilter`."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from estbench import Innovation


class Belief(NamedTuple):
    mean: np.ndarray  # x̂ (run, n)
    cov: np.ndarray  # P (run, n, n)
    start: np.ndarray  # where the gain is computed (1, n)
    dt: float = 0.0


class MyFilter:
    """Steady-state Kalman filter: the nonlinear model, but one gain, that of the first state."""

    def __init__(self, model, scale: float = 1.0):
        self.model, self.scale = model, scale  # `scale` is a setting: a factor on Q
        self.gains = {}

    def init(self, mean, cov):
        return Belief(mean, cov, mean[:1])

    def predict(self, belief, u, t, dt):
        return belief._replace(mean=self.model.transition(belief.mean, u, t, dt), dt=dt)

    def update(self, belief, y, u, t, channels=None, mask=None):
        key = (belief.dt, None if channels is None else tuple(channels))
        if key not in self.gains:
            self.gains[key] = self.steady(belief.start, t, belief.dt, channels)
        K, S, P = self.gains[key]
        residual = y - self.model.measurement(belief.mean, u, t, channels)
        residual = residual if mask is None else np.where(mask, residual, 0.0)
        white = residual @ np.linalg.inv(np.linalg.cholesky(S)).T
        dof = np.full(len(y), y.shape[1]) if mask is None else mask.sum(axis=1)
        cov = np.broadcast_to(P, belief.cov.shape)
        moved = belief._replace(mean=belief.mean + residual @ K.T, cov=cov)
        return moved, Innovation(residual, S[None], white, (white**2).sum(axis=1), dof)

    def steady(self, x, t, dt, channels):
        u = np.zeros((1, self.model.nu))
        _, (F,) = self.model.transition_jacobian(x, u, t, dt)
        _, (H,) = self.model.measurement_jacobian(x, u, t, channels)
        R = self.model.measurement_noise(t, channels)
        P = solve_discrete_are(F.T, H.T, self.scale * self.model.process_noise(x, u, t, dt), R)
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        return K, S, P - K @ S @ K.T

    def mean(self, belief):
        return belief.mean

    def cov(self, belief):
        return belief.cov
