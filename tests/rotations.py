"""A ball joint seen through its rotation vector, and moments of large rotations by sampling."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estbench.spaces import rotation
from estbench.spaces.manifold import Manifold

BALL = Manifold(("roll", "pitch", "yaw"), ("rad",) * 3, np.array([[0, 0]]))
REST = np.array([[1.0, 0.0, 0.0, 0.0]])
SAMPLES = 400_000


def rotation_matrix(turn):
    """R(c) `(3, 3)` of a rotation vector, by scipy."""
    return Rotation.from_rotvec(turn).as_matrix()


@dataclass(frozen=True, eq=False)
class BallJoint:
    """x⁺ = x ⊞ c ⊞ w, y = A (x ⊖ rest) + v: in the tangent at rest the measurement is linear.

    `turn` is c, a rotation vector; Φ is its rotation matrix transposed.
    """

    A: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    space: Manifold = BALL
    nu: int = 0

    def output(self, channels=None):
        return Manifold.euclidean(len(self.A))

    def transition(self, x, u, t, dt):
        return BALL.plus(x, np.array(self.turn))

    def transition_jacobian(self, x, u, t, dt):
        F = rotation_matrix(self.turn).T
        return self.transition(x, u, t, dt), np.broadcast_to(F, (len(x), 3, 3))

    def process_noise(self, x, u, t, dt):
        return self.Q

    def measurement(self, x, u, t, channels=None):
        return BALL.minus(x, REST) @ self.A.T

    def measurement_jacobian(self, x, u, t, channels=None):
        away = BALL.minus(x, REST)
        return away @ self.A.T, self.A @ np.linalg.inv(rotation.right_jacobian(away))

    def measurement_noise(self, t, channels=None):
        return self.R


@dataclass(frozen=True, eq=False)
class AttitudeSensor(BallJoint):
    """The ball joint with its attitude measured: y = x ⊞ v, R `(3, 3)`; A is not used."""

    def output(self, channels=None):
        return BALL

    def measurement(self, x, u, t, channels=None):
        return x

    def measurement_jacobian(self, x, u, t, channels=None):
        return x, np.broadcast_to(np.eye(3), (len(x), 3, 3))


def moments(points, weights, mean):
    """Mean and second moment of points `(sample, 4)` in the tangent at `mean` `(1, 4)`."""
    away = BALL.minus(points, mean)
    return weights @ away, (away * weights[:, None]).T @ away


def mismatch(cov, expected):
    """Largest |C - E|ᵢⱼ / sqrt(Eᵢᵢ Eⱼⱼ) of two covariances `(3, 3)`."""
    std = np.sqrt(np.diag(expected))
    return (np.abs(cov - expected) / np.outer(std, std)).max()
