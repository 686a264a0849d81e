"""Iterated posterior linearization smoother (García-Fernández, Svensson & Särkkä 2017)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estbench.estimators.beliefs import Fault, Gaussian
from estbench.estimators.linear import joseph
from estbench.estimators.no_return import extended
from estbench.estimators.protocol import Measurement
from estbench.estimators.sigma_points import SigmaPoints
from estbench.estimators.ukf import MEASUREMENT, PREDICTION
from estbench.estimators.update import correct, mark_failed
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.smoothers.backward import check_lengths, joint_factor, resolution, smooth_step
from estbench.spaces.linalg import identity, solve_lower_transposed, symmetrize
from estbench.spaces.manifold import Manifold
from estbench.spaces.semidefinite import eigen_root, psd_root, range_root

Rules = Callable[[int, int], SigmaPoints]
"""The sigma points for a number of a time and PREDICTION or MEASUREMENT."""


@dataclass(frozen=True, eq=False)
class _Affine:
    """b + A e + N(0, noise) in place of a function of the error e."""

    offset: Array
    slope: Array
    noise: Array


def ipls(
    model: Model,
    beliefs: Sequence[Gaussian],
    controls: Sequence[Float[Array, "run nu"]],
    times: Sequence[float],
    measurements: Sequence[Sequence[Measurement]],
    rules: Rules,
    *,
    omega: float = 0.0,
    iterations: int = 10,
    tolerance: float = 1e-3,
) -> list[Gaussian]:
    """Smoothed beliefs at `times`, f and h linearized about the smoothed beliefs themselves.

    Each iteration replaces f and h by their regressions on points of the last smoothed beliefs
    x̄, P̄, f(x̄ ⊞ e) ≈ f̄ ⊞ (A e + ε) with Cov(ε) = Ω, and runs the Kalman filter and the RTS smoother
    of this affine model for the errors e. The first iteration takes the filter's beliefs.

    Cost: one transition and one measurement per sigma point and time, in each iteration. Choose it
    where the filter is far from the smoothed trajectory. On a linear model one iteration is the
    RTS smoother.

    Source: García-Fernández, Svensson & Särkkä, IEEE Trans. Automatic Control 62(4), 2017; Särkkä &
    Svensson 2023, ch. 14.

    Args:
        model: the filter's model.
        beliefs: K + 1 beliefs of the filter; the first is the prior.
        controls: K controls `(run, nu)`, held from one time to the next.
        times: K + 1 instants in s.
        measurements: what arrived at each time; the first list is empty.
        rules: the sigma points of each time.
        omega: how often Ω is counted beyond once.
        iterations: maximal number of linearizations.
        tolerance: a run has converged when no coordinate changes by more standard deviations.

    Returns:
        K + 1 Gaussians; a run that failed in the filter is failed at all times.

    Raises:
        DimensionError: the lists' lengths do not fit.
    """
    check_lengths(beliefs, controls, times)
    prior, smoothed, known = beliefs[0], list(beliefs), resolution(model.space, beliefs)
    active = np.ones(len(prior.mean), bool)
    for _ in range(iterations):
        about = _linearized(model, smoothed, controls, times, measurements, rules, omega)
        errors = _smoothed_errors(model.space, prior, smoothed[0], *about, measurements, known)
        moved = np.zeros(len(active))
        for k, (old, error) in enumerate(zip(smoothed, errors)):
            std = np.sqrt(np.diagonal(error.cov, axis1=-2, axis2=-1))
            step = np.divide(np.abs(error.mean), std, out=np.zeros_like(std), where=std > 0)
            moved = np.maximum(moved, step.max(axis=-1, initial=0.0))
            rows = active[:, None]
            mean = np.where(rows, model.space.plus(old.mean, error.mean), old.mean)
            cov = np.where(rows[..., None], model.space.transport(error.cov, error.mean), old.cov)
            fault = np.where(active, error.fault, Fault.NONE).astype(np.uint8)
            smoothed[k] = mark_failed(replace(old, mean=mean, cov=cov), fault)
        active = active & (moved > tolerance)
        if not active.any():
            break
    return smoothed


def _linearized(
    model: Model,
    smoothed: Sequence[Gaussian],
    controls: Sequence[Array],
    times: Sequence[float],
    measurements: Sequence[Sequence[Measurement]],
    rules: Rules,
    omega: float,
) -> tuple[list[_Affine], list[list[_Affine]]]:
    """Regressions of each transition and of each measurement about the smoothed beliefs.

    The offset of a transition is f̄ ⊖ x̄₊, that of a measurement y ⊖ ŷ.
    """
    space, steps, seen = model.space, [], []
    for k, belief in enumerate(smoothed):
        t, root = times[k], psd_root(belief.cov)
        seen.append([])
        for m in measurements[k]:
            output, rule = model.output(m.channels), rules(k, MEASUREMENT)
            points = rule.draw(space, belief.mean, root)
            images = model.measurement(points, m.u, t, m.channels)
            images, came = extended(space, output, points, images, m.mask)
            predicted, residual, spread = rule.moments(output, images)
            slope, unexplained = rule.regress(residual, spread)
            noise = (1.0 + omega) * unexplained + model.measurement_noise(t, m.channels)
            offset = output.minus(m.y, predicted)
            if came is not None and came is not m.mask:  # of which no return is predicted
                offset = np.where(came, offset, -np.inf)
            seen[k].append(_Affine(offset, _divided(slope, root), symmetrize(noise)))
        if k == len(controls):
            break
        u, dt, rule = controls[k], times[k + 1] - t, rules(k, PREDICTION)
        images = model.transition(rule.draw(space, belief.mean, root), u, t, dt)
        mean, residual, spread = rule.moments(space, images)
        slope, unexplained = rule.regress(residual, spread)
        noise = (1.0 + omega) * unexplained + model.process_noise(belief.mean, u, t, dt)
        slope, following = _divided(slope, root), smoothed[k + 1].mean
        if not space.flat:  # from the tangent at f̄ to that at x̄₊
            shift = space.minus(following, mean)
            slope, noise = space.reset_jacobian(shift) @ slope, space.transport(noise, shift)
        steps.append(_Affine(space.minus(mean, following), slope, symmetrize(noise)))
    return steps, seen


def _smoothed_errors(
    space: Manifold,
    prior: Gaussian,
    first: Gaussian,
    steps: Sequence[_Affine],
    seen: Sequence[Sequence[_Affine]],
    measurements: Sequence[Sequence[Measurement]],
    known: Array,
) -> list[Gaussian]:
    """Kalman filter and RTS smoother of the affine model, for the errors in the tangents."""
    flat = Manifold.euclidean(space.n)
    error = space.minus(prior.mean, first.mean)
    cov = space.transport(prior.cov, space.minus(first.mean, prior.mean))
    filtered, predicted = [], []
    for k, affine in enumerate((None, *steps)):
        fault = prior.fault if k == 0 else np.zeros(len(error), np.uint8)
        if affine is not None:
            error = affine.offset + (affine.slope @ error[..., None])[..., 0]
            cov = symmetrize(affine.slope @ cov @ affine.slope.mT + affine.noise)
            predicted.append(error)
        for h, m in zip(seen[k], measurements[k]):
            residual = h.offset - (h.slope @ error[..., None])[..., 0]
            cross = cov @ h.slope.mT
            c = correct(residual, symmetrize(h.slope @ cross + h.noise), cross, m.mask)
            error, cov = error + c.delta, symmetrize(joseph(cov, c.gain, h.slope, h.noise))
            fault = np.where(fault, fault, c.fault).astype(np.uint8)
        filtered.append(Gaussian(error, cov, fault))
    smoothed = [filtered[-1]]
    for now, affine, ahead in zip(filtered[-2::-1], steps[::-1], predicted[::-1]):
        # Ω, a difference, may be below zero by rounding errors.
        finite = np.isfinite(affine.noise).all(axis=(-2, -1), keepdims=True)
        noise, _ = eigen_root(np.where(finite, affine.noise, 0.0))
        joint = joint_factor(affine.slope, range_root(now.cov), noise)
        smoothed.append(smooth_step(flat, now, ahead, joint, smoothed[-1], known))
    return smoothed[::-1]


def _divided(slope: Array, root: Array) -> Array:
    """A L⁻¹ for a square root L of a covariance; the pseudo-inverse where that is singular."""
    zero = (np.diagonal(root, axis1=-2, axis2=-1) == 0).any(axis=-1)
    rest = zero | np.triu(root, 1).any(axis=(-2, -1))
    regular = np.where(rest[:, None, None], identity(root.shape[-1]), root)
    out = solve_lower_transposed(regular, slope.mT).mT
    if rest.any():
        finite = np.isfinite(root[rest]).all(axis=(-2, -1))[:, None, None]
        inverse = np.linalg.pinv(np.where(finite, root[rest], 0.0), rcond=1e-7)
        out[rest] = slope[rest] @ np.where(finite, inverse, np.nan)
    return out
