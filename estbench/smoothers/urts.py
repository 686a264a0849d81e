"""Unscented Rauch-Tung-Striebel smoother (Särkkä 2008; Särkkä 2013, ch. 9)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.estimators.beliefs import Gaussian
from estbench.estimators.factors import weighted_factor
from estbench.estimators.sigma_points import SigmaPoints, scaled
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.smoothers.backward import (
    check_lengths,
    gaussian,
    resolution,
    smooth_step,
    square_root,
)
from estbench.spaces.semidefinite import psd_root


def urts(
    model: Model,
    posteriors: Sequence[Any],
    controls: Sequence[Float[Array, "run nu"]],
    times: Sequence[float],
    rule: SigmaPoints | None = None,
) -> list[Gaussian]:
    """Smoothed beliefs at `times`, backwards by sigma points drawn from each posterior.

    Cost: one transition per sigma point (2 n + 1) and one Q for each interval. Choose it after a
    UKF or cubature filter, with the same rule. On a linear model it is the batch least-squares
    solution.

    Args:
        model: the filter's model.
        posteriors: K + 1 beliefs with `mean`, `cov` and `fault`, after the updates at `times`.
        controls: K controls `(run, nu)`, held from one time to the next.
        times: K + 1 instants in s.
        rule: sigma points; default the scaled rule with α = 1, β = 2, κ = 0.

    Raises:
        DimensionError: the lists' lengths do not fit.
    """
    check_lengths(posteriors, controls, times)
    space, rule = model.space, rule or scaled(model.space.n)
    known = resolution(space, posteriors)
    smoothed = [gaussian(posteriors[-1])]
    for k in reversed(range(len(controls))):
        now, u, t, dt = posteriors[k], controls[k], times[k], times[k + 1] - times[k]
        root = square_root(now)
        points = model.transition(rule.draw(space, now.mean, root), u, t, dt)
        mean = space.mean(points, rule.mean_weights)
        both = np.concatenate([space.minus(points, mean[:, None]), rule.points @ root.mT], axis=-1)
        noise = np.zeros((len(root), 2 * space.n, space.n))
        noise[:, : space.n] = psd_root(model.process_noise(now.mean, u, t, dt))
        joint = weighted_factor(rule.cov_weights, both, noise)
        smoothed.append(smooth_step(space, gaussian(now), mean, joint, smoothed[-1], known))
    return smoothed[::-1]
