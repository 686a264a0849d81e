"""Unit quaternions (w, x, y, z) and rotation vectors, vectorized over leading axes.

Conventions are MuJoCo's: a rotation vector is in the body frame, q ⊞ φ = q ⊗ exp(φ).
Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter" (2017), eq. 101-103, 183.
"""

import numpy as np

from estbench.shapes import Array
from estbench.spaces.linalg import weighted


def multiply(p: Array, q: Array) -> Array:
    """Hamilton product p ⊗ q of quaternions `(..., 4)`."""
    pw, px, py, pz = np.moveaxis(p, -1, 0)
    qw, qx, qy, qz = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion `(..., 4)`."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def normalize(q: Array) -> Array:
    """Scale quaternions `(..., 4)` to unit length; a zero quaternion becomes the identity."""
    norm = _length(q)
    zero = norm == 0  # a NaN stays a NaN
    return np.where(zero, np.array([1.0, 0.0, 0.0, 0.0]), q / np.where(zero, 1.0, norm))


def _length(v: Array) -> Array:
    return np.sqrt(np.vecdot(v, v))[..., None]


def exp(phi: Array) -> Array:
    """Quaternion `(..., 4)` of the rotation vector φ `(..., 3)` in rad."""
    angle = _length(phi)
    # np.sinc(z) = sin(πz)/(πz), hence sin(θ/2)/θ without a division by zero.
    return np.concatenate(
        [np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * phi], axis=-1
    )


def log(q: Array) -> Array:
    """Rotation vector `(..., 3)` in rad, |φ| <= π, of a unit quaternion; q and -q give the same."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = _length(q[..., 1:])
    cosine = q[..., :1]
    small = sine < 1e-8
    safe = np.where(small, 1.0, sine)
    # atan2(s, c)/s -> 1/c as s -> 0; the next term is of order s², below rounding here.
    factor = np.where(
        small, 2.0 / np.where(small, cosine, 1.0), 2.0 * np.arctan2(sine, cosine) / safe
    )
    return factor * q[..., 1:]


def short_way(angle: Array) -> Array:
    """The angle in [-π, π] that differs from it by whole turns, rad."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


def mean(q: Array, weights: Array, iterations: int = 20) -> Array:
    """Weighted mean m `(..., 4)` of unit quaternions `(..., point, 4)`: Σ wᵢ log(m⁻¹ ⊗ qᵢ) = 0.

    By Gauss-Newton from the first (Hertzberg et al. 2013, eq. 21), until every correction is below
    1e-13 rad.
    """
    q = normalize(q)
    mean = q[..., 0, :]
    for _ in range(iterations):
        delta = weighted(weights, log(multiply(conjugate(mean)[..., None, :], q)))
        settled = (np.abs(delta) <= 1e-13).all(axis=-1, keepdims=True)
        if (settled | np.isnan(mean[..., :1])).all():
            break
        # A settled row stays as it is, so that no row's mean depends on its neighbours.
        mean = np.where(settled, mean, normalize(multiply(mean, exp(delta))))
    return mean


def skew(v: Array) -> Array:
    """The matrix `(..., 3, 3)` of the cross product, v × w = S w with S = skew of v."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    rows = [np.stack(r, axis=-1) for r in ([o, -z, y], [z, o, -x], [-y, x, o])]
    return np.stack(rows, axis=-2)


def right_jacobian(phi: Array) -> Array:
    """J_r(φ) `(..., 3, 3)`: log(exp(φ)⁻¹ ⊗ exp(φ + e)) = J_r(φ) e + O(e²) (Solà eq. 183)."""
    angle = _length(phi)[..., None]
    small = angle < 1e-4
    t = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(t)) / t**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (t - np.sin(t)) / t**3)
    cross = skew(phi)
    return np.eye(3) - a * cross + b * (cross @ cross)
