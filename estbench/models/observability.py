"""Which coordinates of the state the sensors can see, by the linearized observability Gramian."""

import numpy as np

from estbench.errors import ScenarioError
from estbench.models.protocol import Model
from estbench.shapes import Array


def unseen(
    model: Model, x: Array, u: Array, dt: float, scale: Array, steps: int = 200, share: float = 1e-9
) -> list[str]:
    """Names of the coordinates that lie in the unobservable subspace about a nominal state.

    The Gramian Σ Φᵏᵀ Hᵀ R⁻¹ H Φᵏ is scaled by the prior standard deviations, so that its
    eigenvalues are information in units of the prior's; a direction with less than `share` of the
    largest is unseen, and so is a coordinate with half its squared length in such directions.

    Args:
        model: the filter's model.
        x: nominal state `(nx,)`.
        u: nominal control `(nu,)`.
        dt: filter step, s.
        scale: prior standard deviation of each coordinate `(n,)`.
        steps: length of the window.
        share: relative eigenvalue that counts as nothing.
    """
    xs, us = x[None], u[None]
    _, F = model.transition_jacobian(xs, us, 0.0, dt)
    _, H = model.measurement_jacobian(xs, us, 0.0)
    R = model.measurement_noise(0.0)
    white = np.linalg.solve(np.linalg.cholesky(R), H[0] * scale)
    step = F[0] * scale / scale[:, None]
    if not (np.isfinite(white).all() and np.isfinite(step).all()):
        raise ScenarioError("the model's Jacobians at the nominal state are not finite")
    gramian, power = np.zeros_like(step), np.eye(len(scale))
    for _ in range(steps):
        seen = white @ power
        gramian += seen.T @ seen
        power = step @ power
        power /= max(1.0, np.abs(power).max())  # an unstable mode must not drown the others
    values, vectors = np.linalg.eigh(gramian)
    hidden = vectors[:, values <= share * max(values.max(), 1e-300)]
    weight = (hidden**2).sum(axis=1)
    return [name for name, w in zip(model.space.names, weight) if w > 0.5]
