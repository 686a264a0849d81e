"""Rauch-Tung-Striebel smoother for linear and extended filters (Särkkä 2013, eq. 8.6, ch. 9)."""

from collections.abc import Sequence
from typing import Any

from estbench.estimators.beliefs import Gaussian
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.smoothers.backward import (
    check_lengths,
    gaussian,
    joint_factor,
    resolution,
    smooth_step,
    square_root,
)
from estbench.spaces.semidefinite import psd_root


def rts(
    model: Model,
    posteriors: Sequence[Any],
    controls: Sequence[Float[Array, "run nu"]],
    times: Sequence[float],
) -> list[Gaussian]:
    """Smoothed beliefs at `times` from the posteriors of the filter, by the Jacobian of the model.

    Cost: one transition Jacobian and one Q for each interval. Choose it after a KF, EKF, IEKF or
    their square-root forms; it linearizes at the filtered means and does not iterate (see
    `map_estimate`). On a linear model it is the batch least-squares solution. P₀ and the predicted
    covariances may be singular, and P₀ as large as the filter takes it.

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
    space, known = model.space, resolution(model.space, posteriors)
    smoothed = [gaussian(posteriors[-1])]
    for k in reversed(range(len(controls))):
        now, u, t, dt = posteriors[k], controls[k], times[k], times[k + 1] - times[k]
        root = square_root(now)
        mean, F = model.transition_jacobian(now.mean, u, t, dt)
        joint = joint_factor(F, root, psd_root(model.process_noise(now.mean, u, t, dt)))
        smoothed.append(smooth_step(space, gaussian(now), mean, joint, smoothed[-1], known))
    return smoothed[::-1]
