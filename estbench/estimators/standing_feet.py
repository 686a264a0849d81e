"""Feet on the ground: where they are, and how they roll and slip."""

import numpy as np
from scipy.special import chdtri

from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import cholesky, solve_lower


def rolling(
    rate: Float[Array, "run 3"],
    turns: Float[Array, "run foot 3 joint"],
    speeds: Float[Array, "run joint"],
    R: Float[Array, "run 3 3"],
    radii: Float[Array, " foot"],
    up: Float[Array, " 3"],
) -> Float[Array, "run foot 3"]:
    """Velocity of the centres of spherical feet in the world, m/s: r ω x e.

    The lowest point of a foot that rolls is at rest; ω = R (ω_IMU + T dq/dt) is that of the foot.

    Args:
        rate: ω_IMU, in its axes, rad/s.
        turns: T, Jacobian of each foot's orientation against the IMU.
        speeds: dq/dt, rad/s.
        R: attitude of the IMU.
        radii: r of each foot, m; 0 of a foot that is no sphere.
        up: e, normal of the ground, of length 1.
    """
    if not radii.any():
        return np.zeros((*turns.shape[:2], 3))
    foot = rate[:, None] + (turns @ speeds[:, None, :, None])[..., 0]
    return radii[:, None] * np.cross(foot @ R.mT, up)


def slipping(
    residual: Float[Array, "run f"], S: Float[Array, "run f f"], gate: float
) -> Bool[Mask, "run foot"]:
    """Whether the NIS of a foot's three numbers is above the chi-square quantile of the gate.

    Bloesch, Gehring, Fankhauser, Hutter, Hoepflinger & Siegwart, "State estimation for legged
    robots on unstable and slippery terrain", IROS 2013.

    Args:
        residual: ν of all feet, three numbers each.
        S: its covariance.
        gate: probability that a foot that stands passes; with 1 no foot slips.
    """
    runs, feet = len(residual), residual.shape[1] // 3
    at = np.arange(3 * feet).reshape(feet, 3)
    own = cholesky(S[:, at[:, :, None], at[:, None, :]].reshape(-1, 3, 3))
    white = solve_lower(own, residual.reshape(-1, 3, 1))
    return ((white**2).sum(axis=(-2, -1)) > chdtri(3, 1.0 - gate)).reshape(runs, feet)


def reaches(m: Float[Array, "run k"], feet: int) -> Float[Array, "run foot 3"]:
    """dᵢ - p of each foot, from the IMU to it in the axes of the world, of the states m."""
    return m[:, 10 : 10 + 3 * feet].reshape(len(m), feet, 3) - m[:, None, 7:10]


def blocks(values: Float[Array, "run foot 3 3"]) -> Float[Array, "run f f"]:
    """A block-diagonal matrix of one block for each foot."""
    runs, feet = values.shape[:2]
    out = np.zeros((runs, 3 * feet, 3 * feet))
    for i in range(feet):
        out[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = values[:, i]
    return out
