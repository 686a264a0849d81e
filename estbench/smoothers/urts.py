"""Unscented Rauch-Tung-Striebel smoother (Särkkä 2008; Särkkä 2013, ch. 9)."""

from collections.abc import Callable, Sequence
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
    rules: Callable[[int], SigmaPoints] | None = None,
    omega: float = 0.0,
) -> list[Gaussian]:
    """Smoothed beliefs at `times`, backwards by sigma points drawn from each posterior.

    Cost: one transition per sigma point (2 n + 1) and one Q for each interval. Choose it after a
    sigma-point filter, with the same points: x̂⁻, P⁻ = Σ wᵢ rᵢ rᵢᵀ + ω Ω + Q and the gain
    Σ wᵢ L ξᵢ rᵢᵀ (P⁻)⁻¹ are then those of the filter's prediction. On a linear model it is the
    batch least-squares solution.

    Args:
        model: the filter's model.
        posteriors: K + 1 beliefs with `mean`, `cov` and `fault`, after the updates at `times`.
        controls: K controls `(run, nu)`, held from one time to the next.
        times: K + 1 instants in s.
        rules: the sigma points for the number of a time; default the scaled rule with α = 1,
            β = 2, κ = 0 at each.
        omega: ω, how often the filter counts Ω, the covariance of the linearization error, beyond
            once.

    Raises:
        DimensionError: the lists' lengths do not fit.
    """
    check_lengths(posteriors, controls, times)
    space, default = model.space, scaled(model.space.n)
    known = resolution(space, posteriors)
    smoothed = [gaussian(posteriors[-1])]
    for k in reversed(range(len(controls))):
        now, u, t, dt = posteriors[k], controls[k], times[k], times[k + 1] - times[k]
        root, rule = square_root(now), rules(k) if rules else default
        points = model.transition(rule.draw(space, now.mean, root), u, t, dt)
        mean, residual = rule.residuals(space, points)
        noise = np.zeros((len(root), 2 * space.n, space.n))
        noise[:, : space.n] = psd_root(model.process_noise(now.mean, u, t, dt))
        joint = weighted_factor(*_spread(rule, omega, residual, root), noise)
        smoothed.append(smooth_step(space, gaussian(now), mean, joint, smoothed[-1], known))
    return smoothed[::-1]


def _spread(
    rule: SigmaPoints,
    omega: float,
    residual: Float[Array, "run point n"],
    root: Float[Array, "run n n"],
) -> tuple[Float[Array, " row"], Float[Array, "run row both"]]:
    """Weights and rows whose weighted squares are the joint covariance of (x₊, x) with ω Ω.

    The rows are the (rᵢ, L ξᵢ), and (√ω eᵢ, 0) with the residuals eᵢ of the regression, of which
    Ω = Σ wᵢ eᵢ eᵢᵀ. A negative weight stays the first and only one: at the centre e₀ = r₀.
    """
    weights, rows = rule.cov_weights, np.concatenate([residual, rule.points @ root.mT], axis=-1)
    if not omega:
        return weights, rows
    slope = rule.cross(residual, np.broadcast_to(rule.points, residual.shape))
    error = np.zeros_like(rows)
    error[..., : residual.shape[-1]] = np.sqrt(omega) * (residual - rule.points @ slope.mT)
    down = int(weights[0] < 0)
    rows[:, :down] *= np.sqrt(1.0 + omega)
    return (
        np.concatenate([weights, weights[down:]]),
        np.concatenate([rows, error[:, down:]], axis=1),
    )
