"""Unit quaternions (w, x, y, z) and rotation vectors, vectorized over leading axes.

Conventions are MuJoCo's: a rotation vector is in the body frame, q ⊞ φ = q ⊗ exp(φ).
Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter" (2017), eq. 101-103, 183.
"""

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.linalg import weighted


def multiply(p: Float[Array, "... 4"], q: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Hamilton product p ⊗ q of quaternions."""
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


def conjugate(q: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Inverse of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def normalize(q: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Scale quaternions to unit length; a zero quaternion becomes the identity."""
    norm = _length(q)
    zero = norm == 0  # a NaN stays a NaN
    if not zero.any():
        return q / norm
    return np.where(zero, np.array([1.0, 0.0, 0.0, 0.0]), q / np.where(zero, 1.0, norm))


def _length(v: Array) -> Array:
    return np.sqrt(np.vecdot(v, v))[..., None]


def exp(phi: Float[Array, "*any 3"]) -> Float[Array, "*any 4"]:
    """Quaternion of the rotation vector φ in rad."""
    angle = _length(phi)
    # np.sinc(z) = sin(πz)/(πz), hence sin(θ/2)/θ without a division by zero.
    return np.concatenate(
        [np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * phi], axis=-1
    )


def log(q: Float[Array, "*any 4"]) -> Float[Array, "*any 3"]:
    """Rotation vector in rad, |φ| <= π, of a unit quaternion; q and -q have the same."""
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


def short_way(angle: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """The equivalent angle in [-π, π], rad."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


def mean_angle(
    angles: Float[Array, "*any point k"], weights: Float[Array, "... point"], iterations: int = 20
) -> Float[Array, "*any k"]:
    """Weighted mean m of angles on the circle: Σ wᵢ short_way(aᵢ - m) = 0.

    Gauss-Newton iterations from the mean direction atan2(Σ |wᵢ| sin aᵢ, Σ |wᵢ| cos aᵢ) (Mardia &
    Jupp 2000, sec. 2.2), until every correction is below 1e-13 rad. Where all angles are within π
    of the mean it is the mean on the real line. Of the equivalent values the one within π of the
    first angle is returned.
    """
    size = np.abs(weights)
    mean = np.arctan2(weighted(size, np.sin(angles)), weighted(size, np.cos(angles)))
    for _ in range(iterations):
        delta = weighted(weights, short_way(angles - mean[..., None, :]))
        converged = ~(np.abs(delta) > 1e-13)  # or NaN
        # A converged mean is not changed, so that it depends on its own row alone.
        mean = np.where(converged, mean, mean + delta)
        if converged.all():
            break
    first = angles[..., 0, :]
    return first + short_way(mean - first)


def mean(
    q: Float[Array, "*any point 4"], weights: Float[Array, "... point"], iterations: int = 20
) -> Float[Array, "*any 4"]:
    """Weighted mean m of unit quaternions: Σ wᵢ log(m⁻¹ ⊗ qᵢ) = 0.

    Computed by Gauss-Newton iterations from the first quaternion (Hertzberg et al. 2013, eq. 21),
    until every correction is below 1e-13 rad.
    """
    q = normalize(q)
    mean = q[..., 0, :]
    for _ in range(iterations):
        delta = weighted(weights, log(multiply(conjugate(mean)[..., None, :], q)))
        converged = (np.abs(delta) <= 1e-13).all(axis=-1, keepdims=True)
        if (converged | np.isnan(mean[..., :1])).all():
            break
        # A converged row is not changed, so that the mean of a row depends on that row alone.
        mean = np.where(converged, mean, normalize(multiply(mean, exp(delta))))
    return mean


def matrix(q: Float[Array, "*any 4"]) -> Float[Array, "*any 3 3"]:
    """The rotation matrix R of a unit quaternion: R v is v turned (Solà eq. 115)."""
    x, y, z = q[..., 1], q[..., 2], q[..., 3]
    double = 2.0 * q
    ww, xx, yy, zz = (q[..., i] * q[..., i] for i in range(4))
    xy, xz, yz = double[..., 1] * y, double[..., 1] * z, double[..., 2] * z
    wx, wy, wz = (double[..., 0] * part for part in (x, y, z))
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = ww + xx - yy - zz, xy - wz, xz + wy
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = xy + wz, ww - xx + yy - zz, yz - wx
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = xz - wy, yz + wx, ww - xx - yy + zz
    return out


def from_matrix(R: Float[Array, "3 3"]) -> Float[Array, " 4"]:
    """A unit quaternion of one rotation matrix: the largest eigenvector of Bar-Itzhack's K."""
    K = np.empty((4, 4))
    K[0, 0], K[1:, 1:] = np.trace(R), R + R.T - np.trace(R) * np.eye(3)
    K[0, 1:] = K[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    return np.linalg.eigh(K)[1][:, -1]


def skew(v: Float[Array, "*any 3"]) -> Float[Array, "*any 3 3"]:
    """The matrix S of the cross product: v × w = S w."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return out


def right_jacobian(phi: Float[Array, "*any 3"]) -> Float[Array, "*any 3 3"]:
    """J_r(φ): log(exp(φ)⁻¹ ⊗ exp(φ + e)) = J_r(φ) e + O(e²) (Solà eq. 183)."""
    angle = _length(phi)[..., None]
    small = angle < 1e-4
    t = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(t)) / t**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (t - np.sin(t)) / t**3)
    cross = skew(phi)
    return np.eye(3) - a * cross + b * (cross @ cross)
