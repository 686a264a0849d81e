"""Unscented Rauch-Tung-Striebel smoother (Särkkä 2008; Särkkä 2013, ch. 9)."""

from collections.abc import Sequence
from typing import Any

from estbench.estimators.beliefs import Gaussian
from estbench.estimators.sigma_points import SigmaPoints, scaled
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.smoothers.rts import check_lengths, gaussian, smooth_step
from estbench.spaces.linalg import cholesky, symmetrize


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
    smoothed = [gaussian(posteriors[-1])]
    for k in reversed(range(len(controls))):
        now, u, t, dt = gaussian(posteriors[k]), controls[k], times[k], times[k + 1] - times[k]
        lower = cholesky(now.cov)
        points = model.transition(rule.draw(space, now.mean, lower), u, t, dt)
        mean, residual, cov = rule.moments(space, points)
        cross = rule.cross(rule.points @ lower.mT, residual)
        cov = symmetrize(cov + model.process_noise(now.mean, u, t, dt))
        smoothed.append(smooth_step(space, now, mean, cov, cross, smoothed[-1]))
    return smoothed[::-1]
