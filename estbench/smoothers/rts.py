"""Rauch-Tung-Striebel smoother for linear and extended filters (Särkkä 2013, eq. 8.6, ch. 9)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.errors import DimensionError
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ukf import failed_factor
from estbench.estimators.update import apply_correction
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.spaces.linalg import cholesky, solve_lower, solve_lower_transposed, symmetrize
from estbench.spaces.manifold import Manifold


def rts(
    model: Model,
    posteriors: Sequence[Any],
    controls: Sequence[Float[Array, "run nu"]],
    times: Sequence[float],
) -> list[Gaussian]:
    """Smoothed beliefs at `times` from the posteriors of the filter, by the Jacobian of the model.

    Cost: one transition Jacobian and one Q for each interval. Choose it after a KF, EKF, IEKF or
    their square-root forms; it linearizes at the filtered means and does not iterate (see
    `map_estimate`). On a linear model it is the batch least-squares solution.

    Args:
        model: the filter's model.
        posteriors: K + 1 beliefs with `mean`, `cov` and `fault`, after the updates at `times`.
        controls: K controls `(run, nu)`, held from one time to the next.
        times: K + 1 instants in s.

    Returns:
        K + 1 Gaussians; a run that failed in the filter is failed at all times.

    Raises:
        DimensionError: the lists' lengths do not fit.
    """
    check_lengths(posteriors, controls, times)
    smoothed = [gaussian(posteriors[-1])]
    for k in reversed(range(len(controls))):
        now, u, t, dt = gaussian(posteriors[k]), controls[k], times[k], times[k + 1] - times[k]
        mean, F = model.transition_jacobian(now.mean, u, t, dt)
        cross = now.cov @ F.mT
        cov = symmetrize(F @ cross + model.process_noise(now.mean, u, t, dt))
        smoothed.append(smooth_step(model.space, now, mean, cov, cross, smoothed[-1]))
    return smoothed[::-1]


def smooth_step(
    space: Manifold,
    now: Gaussian,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    cross: Float[Array, "run n n"],
    later: Gaussian,
) -> Gaussian:
    """One step backwards: G = cross P⁻⁻¹, x̂ˢ = x̂ ⊞ G (x̂ˢ₊ ⊖ x̂⁻), Pˢ = P + G (Pˢ₊ - P⁻) Gᵀ.

    Args:
        space: the state's manifold.
        now: the filter's posterior.
        mean: x̂⁻ of the next time.
        cov: P⁻ of the next time.
        cross: Cov(x, x₊), P Φᵀ for a linearized model.
        later: the smoothed belief of the next time; its covariance is first mapped to the tangent
            at x̂⁻, and the result to that at x̂ˢ.
    """
    lower = cholesky(cov)
    half = solve_lower(lower, cross.mT)
    gain = np.swapaxes(solve_lower_transposed(lower, half), -1, -2)
    ahead = space.minus(later.mean, mean)
    after = space.transport(later.cov, space.minus(mean, later.mean))
    delta = (gain @ ahead[..., None])[..., 0]
    smoothed = symmetrize(now.cov + gain @ (after - cov) @ gain.mT)
    fault = np.where(later.fault, later.fault, failed_factor(lower, cov))
    return apply_correction(space, now, delta, smoothed, fault)


def gaussian(belief: Any) -> Gaussian:
    """A belief with mean, cov and fault as a plain `Gaussian`."""
    return Gaussian(belief.mean, belief.cov, belief.fault)


def check_lengths(
    states: Sequence[Any], controls: Sequence[Float[Array, "run nu"]], times: Sequence[float]
) -> None:
    """Raise unless there is one state per time, and one control less."""
    if not len(states) == len(times) == len(controls) + 1:
        raise DimensionError(
            f"{len(states)} beliefs, {len(controls)} controls and {len(times)} times do not fit; "
            "give K + 1 beliefs, K controls and K + 1 times"
        )
