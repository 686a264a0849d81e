"""Batch maximum a posteriori trajectory by Gauss-Newton on the sparse least-squares problem.

It minimizes |x₀ ⊖ m₀|²_P₀ + Σ |x₊ ⊖ f(x)|²_Q + Σ |y ⊖ h(x)|²_R (Bell 1994; Barfoot 2017, sec.
4.3.1). Each step solves Hachtel's augmented system [W J; Jᵀ 0] (λ, e) = (-r, 0), whose
W = diag(P₀, Q, R) may be singular: a Q without noise on the positions is a constraint, not a
division by zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # imports its sparse matrices at their first use, with much else
from numpy.typing import NDArray

from estbench.estimators.beliefs import Fault, Gaussian
from estbench.estimators.linear import without_absent
from estbench.estimators.no_return import returned
from estbench.estimators.protocol import Measurement
from estbench.estimators.update import mark_failed
from estbench.models.protocol import Model
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.smoothers.backward import check_lengths
from estbench.spaces.linalg import quadratic_form, symmetrize
from estbench.spaces.manifold import carry

_SMALLEST = 2.0**-6
"""Smallest factor to which a step is halved while the cost rises; such a step is then accepted."""


@dataclass(frozen=True, eq=False)
class MapEstimate:
    """The trajectory and the course of the iteration.

    Attributes:
        beliefs: one Gaussian per time: the mode, and the covariance of the linearized problem (zero
            if it was not asked for).
        iterations: number of linearizations of each run.
        converged: whether the last step of each run was below the tolerance.
    """

    beliefs: list[Gaussian]
    iterations: Int[Ints, " run"]
    converged: Bool[Mask, " run"]


@dataclass(frozen=True, eq=False)
class _System:
    """The sparse system as blocks, the same places in every run.

    Attributes:
        noise: `(row, block)` of W, block `(run, k, k)`.
        slopes: `(row, state, block)` of J, block `(run, k, n)`.
        residual: r `(run, rows)`.
    """

    noise: list[tuple[int, Array]]
    slopes: list[tuple[int, int, Array]]
    residual: Array


def map_estimate(
    model: Model,
    prior: Gaussian,
    controls: Sequence[Float[Array, "run nu"]],
    times: Sequence[float],
    measurements: Sequence[Sequence[Measurement]],
    *,
    start: Sequence[Float[Array, "run nx"]] | None = None,
    iterations: int = 20,
    tolerance: float = 1e-9,
    covariance: bool = True,
) -> MapEstimate:
    """The most probable trajectory at `times` of a whole run or of a window.

    Cost: K transition and K + 1 measurement Jacobians per Gauss-Newton step, and a sparse solution
    per run; the covariances take n further substitutions per time. Choose it as the reference that
    no filter beats, and where linearizing once (RTS) is not enough. A step that raises the cost is
    halved; start from a filter's means where the model is strongly nonlinear.

    Args:
        model: the filter's model.
        prior: the belief at the first time before its measurement; P₀ may be singular.
        controls: K controls `(run, nu)`, held from one time to the next.
        times: K + 1 instants in s.
        measurements: what arrived at each time: none, one, or several.
        start: K + 1 states `(run, nx)`; default the prior mean propagated by the model.
        iterations: maximal number of linearizations, including halvings.
        tolerance: a run has converged when no coordinate changes by more, in its own unit.
        covariance: whether to compute the covariances.

    Raises:
        DimensionError: the lists' lengths do not fit.
    """
    check_lengths(measurements, controls, times)
    space, count = model.space, len(times)
    if start is None:
        states = [prior.mean]
        for k in range(count - 1):
            dt = times[k + 1] - times[k]
            states.append(model.transition(states[-1], controls[k], times[k], dt))
    else:
        check_lengths(start, controls, times)
        states = list(start)
    trial = np.stack(states, axis=1)
    runs = len(trial)
    fault = prior.fault.copy()
    taken, converged = np.zeros(runs, np.int64), np.zeros(runs, bool)
    x, step, scale = trial, np.zeros((runs, count, space.n)), np.ones(runs)
    best = np.full(runs, np.inf)
    for _ in range(iterations):
        active = ~converged & (fault == 0)
        if not active.any():
            break
        taken += active
        system = _linearize(model, prior, controls, times, measurements, trial)
        cost = _cost(system)
        rounding = 1e-10 * (1.0 + cost)
        worse = active & (cost > best + rounding) & (scale > _SMALLEST)
        better = active & ~worse
        # Where the change is lost in rounding the scale that got there is kept.
        longer = np.where(cost < best - rounding, np.minimum(2.0 * scale, 1.0), scale)
        scale = np.where(worse, 0.5 * scale, longer)
        x = np.where(better[:, None, None], trial, x)
        best = np.where(better, cost, best)
        new, failed = _solve(system, count, space.n, better)
        step = np.where(better[:, None, None], new, step)
        fault = np.where(fault, fault, failed).astype(np.uint8)
        moved = space.plus(x, scale[:, None, None] * step)
        trial = np.where(active[:, None, None], moved, trial)
        converged |= better & (np.abs(step).max(axis=(1, 2)) <= tolerance)
    x = trial
    P = np.zeros((runs, count, space.n, space.n))
    if covariance:
        system = _linearize(model, prior, controls, times, measurements, x)
        P = _covariances(system, count, space.n, fault == 0)
    beliefs = [mark_failed(Gaussian(x[:, k], P[:, k], prior.fault), fault) for k in range(count)]
    return MapEstimate(beliefs, taken, converged)


def _linearize(
    model: Model,
    prior: Gaussian,
    controls: Sequence[Array],
    times: Sequence[float],
    measurements: Sequence[Sequence[Measurement]],
    x: Array,
) -> _System:
    """Residuals, slopes and noise at the trajectory x `(run, time, nx)`.

    A residual a ⊖ b with noise in the tangent at b is written in the tangent at a, where it is
    (a ⊖ b) + eₐ - R(a ⊖ b)ᵀ e_b with the noise carried along: exact on the manifold.
    """
    space, runs = model.space, len(x)
    eye = np.broadcast_to(np.eye(space.n), (runs, space.n, space.n))
    first = space.minus(x[:, 0], prior.mean)
    residuals = [first]
    noise = [(0, space.transport(prior.cov, first))]
    slopes = [(0, 0, eye)]
    row = space.n
    for k, u in enumerate(controls):
        t, dt = times[k], times[k + 1] - times[k]
        moved, F = model.transition_jacobian(x[:, k], u, t, dt)
        Q = np.broadcast_to(model.process_noise(x[:, k], u, t, dt), eye.shape)
        w = space.minus(x[:, k + 1], moved)
        residuals.append(w)
        noise.append((row, space.transport(Q, w)))
        slopes += [(row, k + 1, eye), (row, k, -carry(space, w, F, eye)[0])]
        row += space.n
    for k, measurement in ((k, m) for k, at_once in enumerate(measurements) for m in at_once):
        y, u, channels, mask = (getattr(measurement, a) for a in ("y", "u", "channels", "mask"))
        output, m = model.output(channels), model.output(channels).n
        predicted, H = model.measurement_jacobian(x[:, k], u, times[k], channels)
        R = np.broadcast_to(model.measurement_noise(times[k], channels), (runs, m, m))
        v = output.minus(y, predicted)
        v, H, R = without_absent(v, H, R, returned(v, mask))
        H, _ = carry(output, v, H, H)
        residuals.append(v)
        noise.append((row, output.transport(R, v)))
        slopes.append((row, k, -H))
        row += m
    return _System(noise, slopes, np.concatenate(residuals, axis=-1))


def _factors(system: _System, states: int, n: int, active: NDArray[np.bool_]):
    """For each active run its index and the factorized system (None where it is singular)."""
    rows = system.residual.shape[-1]
    at_row, at_col, values = [], [], []

    def add(row: int, column: int, block: Array) -> None:
        r, c = np.indices(block.shape[1:])
        at_row.append((r + row).ravel())
        at_col.append((c + column).ravel())
        values.append(block.reshape(len(block), -1))

    for row, block in system.noise:
        add(row, row, block)
    for row, state, block in system.slopes:
        add(row, rows + n * state, block)
        add(rows + n * state, row, block.mT)
    places = np.concatenate(at_row), np.concatenate(at_col)
    entries = np.concatenate(values, axis=-1)
    size = rows + n * states
    # scipy factorizes one sparse matrix at a time, so this loop over runs cannot be avoided.
    for run in np.flatnonzero(active):
        if not np.isfinite(entries[run]).all():
            yield run, None
            continue
        try:
            matrix = scipy.sparse.csc_matrix((entries[run], places), shape=(size, size))
            yield run, scipy.sparse.linalg.splu(matrix)
        except RuntimeError:  # exactly singular
            yield run, None


def _cost(system: _System) -> Array:
    """Σ rᵀ W⁻¹ r `(run,)`, each block of W enlarged by 1e-6 of its greatest variance."""
    total = np.zeros(len(system.residual))
    for row, block in system.noise:
        k = block.shape[-1]
        largest = np.diagonal(block, axis1=-2, axis2=-1).max(axis=-1, initial=1e-12)
        enlarged = block + 1e-6 * largest[:, None, None] * np.eye(k)
        total += quadratic_form(enlarged, system.residual[:, row : row + k])
    return total


def _solve(
    system: _System, states: int, n: int, active: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.uint8]]:
    """The Gauss-Newton step `(run, time, n)` and the new faults."""
    runs, rows = system.residual.shape
    step, fault = np.zeros((runs, states, n)), np.zeros(runs, np.uint8)
    right = np.concatenate([-system.residual, np.zeros((runs, n * states))], axis=-1)
    for run, factor in _factors(system, states, n, active):
        if not np.isfinite(right[run]).all():
            step[run], fault[run] = np.nan, Fault.STATE
            continue
        if factor is not None:
            step[run] = factor.solve(right[run])[rows:].reshape(states, n)
        if factor is None or not np.isfinite(step[run]).all():
            step[run], fault[run] = np.nan, Fault.COVARIANCE
    return step, fault


def _covariances(system: _System, states: int, n: int, active: NDArray[np.bool_]) -> Array:
    """Diagonal blocks `(run, time, n, n)` of (Jᵀ W⁻¹ J)⁻¹, time by time."""
    runs, rows = system.residual.shape
    out = np.full((runs, states, n, n), np.nan)
    for run, factor in _factors(system, states, n, active):
        if factor is None:
            continue
        for k in range(states):
            here = slice(rows + n * k, rows + n * (k + 1))
            right = np.zeros((rows + n * states, n))
            right[here] = -np.eye(n)
            out[run, k] = symmetrize(factor.solve(right)[here])
    return out
