"""A package of an estimator: an EKF in the terms of the textbook, on the manifold of the state.

`pip install examples/textbook_ekf` installs it; its entry point is in `pyproject.toml`. Then
`estbench run cartpole -e textbook` and `estbench leaderboard textbook-ekf` find it by name.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from estbench import Innovation, Model


@dataclass(frozen=True)
class TextbookEKF:
    model: Model

    def init(self, mean, cov):
        return SimpleNamespace(mean=mean, cov=cov)

    def predict(self, belief, u, t, dt):
        mean, F = self.model.transition_jacobian(belief.mean, u, t, dt)
        Q = self.model.process_noise(belief.mean, u, t, dt)
        return SimpleNamespace(mean=mean, cov=F @ belief.cov @ F.mT + Q)

    def update(self, belief, y, u, t, channels=None, mask=None):
        predicted, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        R = self.model.measurement_noise(t, channels)
        residual = self.model.output(channels).minus(y, predicted)
        here = np.ones(residual.shape, bool) if mask is None else mask
        H, residual = np.where(here[..., None], H, 0.0), np.where(here, residual, 0.0)
        both = here[:, :, None] & here[:, None, :]
        R = np.where(both, R, np.eye(residual.shape[1]))
        S = H @ belief.cov @ H.mT + R
        white = np.linalg.solve(np.linalg.cholesky(S), residual[..., None])[..., 0]
        K = np.linalg.solve(S, H @ belief.cov).mT
        mean = self.model.space.plus(belief.mean, (K @ residual[..., None])[..., 0])
        cov = belief.cov - K @ S @ K.mT
        after = SimpleNamespace(mean=mean, cov=0.5 * (cov + cov.mT))
        return after, Innovation(residual, S, white, (white**2).sum(axis=-1), here.sum(axis=-1))

    def mean(self, belief):
        return belief.mean

    def cov(self, belief):
        return belief.cov
