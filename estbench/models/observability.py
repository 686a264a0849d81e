"""Unobservable coordinates of the state, by the linearized observability Gramian."""

import numpy as np

from estbench.errors import ScenarioError
from estbench.models.protocol import Model
from estbench.shapes import Array, Float

_EXACT = 1e-12
"""Variance, (unit)², that stands for that of a reading without noise."""


def unseen(
    model: Model,
    x: Float[Array, " nx"],
    u: Float[Array, " nu"],
    dt: float,
    scale: Float[Array, " n"],
    steps: int = 200,
    share: float = 1e-9,
) -> list[str]:
    """Names of the coordinates that lie in the unobservable subspace at a nominal state.

    The Gramian Σ Φᵏᵀ Hᵀ R⁻¹ H Φᵏ is scaled by the prior standard deviations: its eigenvalues are
    information relative to the prior. A direction is unobservable if its eigenvalue is below
    `share` of the largest. A coordinate is unobservable if more than half of its squared length
    lies in such directions.

    Args:
        model: the filter's model.
        x: nominal state.
        u: nominal control.
        dt: filter step, s.
        scale: prior standard deviation of each coordinate.
        steps: number of terms of the sum.
        share: relative eigenvalue below which a direction is unobservable.
    """
    xs, us = x[None], u[None]
    _, F = model.transition_jacobian(xs, us, 0.0, dt)
    _, H = model.measurement_jacobian(xs, us, 0.0)
    R = model.measurement_noise(0.0)
    exact = np.diag(np.where(np.diagonal(R) > 0, 0.0, _EXACT))
    white = np.linalg.solve(np.linalg.cholesky(R + exact), H[0] * scale)
    step = F[0] * scale / scale[:, None]
    if not (np.isfinite(white).all() and np.isfinite(step).all()):
        raise ScenarioError("the model's Jacobians at the nominal state are not finite")
    gramian, power = np.zeros_like(step), np.eye(len(scale))
    for _ in range(steps):
        seen = white @ power
        gramian += seen.T @ seen
        power = step @ power
        power /= max(1.0, np.abs(power).max())  # an unstable mode must not dominate the sum
    values, vectors = np.linalg.eigh(gramian)
    hidden = vectors[:, values <= share * max(values.max(), 1e-300)]
    weight = (hidden**2).sum(axis=1)
    return [name for name, w in zip(model.space.names, weight) if w > 0.5]
