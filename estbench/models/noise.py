"""The covariance Q of one step from a spectral density Q_s.

Every function assumes white noise of density Q_s. With `held` the noise is instead constant over
the step, N(0, Q_s/dt), as for the `force` disturbance of a MuJoCo model.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from estbench.errors import CovarianceError, DimensionError
from estbench.shapes import Array, Float


def van_loan(
    F: Float[Array, "*lead n n"],
    Q_s: Float[Array, "*other k k"],
    dt: float,
    G: Float[Array, "... n k"] | None = None,
) -> tuple[Float[Array, "... n n"], Float[Array, "... n n"]]:
    """Exact Φ and Q of ẋ = F x + G w over dt (Van Loan 1978, theorem 1).

    exp([[-F, G Q_s Gᵀ], [0, Fᵀ]] dt) = [[., Φ⁻¹ Q], [0, Φᵀ]].

    Args:
        F: system matrix, 1/s; it may have a leading run axis, as may the others.
        Q_s: spectral density of w, unit²/Hz.
        dt: step, s.
        G: noise input matrix; default the identity.

    Returns:
        Φ and Q.

    Raises:
        DimensionError: Q_s does not fit F and G.
    """
    n = F.shape[-1]
    width = n if G is None else G.shape[-1]
    if Q_s.shape[-2:] != (width, width):
        raise DimensionError(f"Q_s has shape {Q_s.shape}; expected {(width, width)}")
    driven = Q_s if G is None else G @ Q_s @ G.mT
    lead = np.broadcast_shapes(F.shape[:-2], driven.shape[:-2])
    block = np.zeros((*lead, 2 * n, 2 * n))
    block[..., :n, :n], block[..., :n, n:] = -F, driven
    block[..., n:, n:] = F.mT
    exponential = np.asarray(expm(block * dt), np.float64)
    Phi = exponential[..., n:, n:].mT
    Q = Phi @ exponential[..., :n, n:]
    return Phi, 0.5 * (Q + Q.mT)


def white_acceleration(dt: float, q: ArrayLike, held: bool = False) -> Float[Array, "n n"]:
    """Q of k positions and k velocities, n = 2 k, under white acceleration.

    Continuous (Bar-Shalom, Li & Kirubarajan 2001, sec. 6.2.2):
    q [[dt³/3, dt²/2], [dt²/2, dt]]; held (sec. 6.3.2): (q/dt) γ γᵀ with γ = (dt²/2, dt).

    Args:
        dt: step, s.
        q: spectral density of the acceleration `()` or `(k,)`, (m/s²)²/Hz.
        held: whether the acceleration is constant over the step.
    """
    return _integrated(2, dt, q, held)


def white_jerk(dt: float, q: ArrayLike, held: bool = False) -> Float[Array, "n n"]:
    """Q of k positions, velocities and accelerations, n = 3 k, under white jerk.

    Continuous (Bar-Shalom, Li & Kirubarajan 2001, sec. 6.2.3): q times
    [[dt⁵/20, dt⁴/8, dt³/6], [dt⁴/8, dt³/3, dt²/2], [dt³/6, dt²/2, dt]];
    held: (q/dt) γ γᵀ with γ = (dt³/6, dt²/2, dt).

    Args:
        dt: step, s.
        q: spectral density of the jerk `()` or `(k,)`, (m/s³)²/Hz.
        held: whether the jerk is constant over the step.
    """
    return _integrated(3, dt, q, held)


def scheduled(times: Sequence[float], values: ArrayLike) -> Callable[[float], Array]:
    """A piecewise constant matrix: `values[i]` from `times[i]` on, `values[0]` before.

    It serves as the Q_s(t) or R(t) of a `ContinuousFunctionModel`.

    Args:
        times: increasing, s.
        values: `(len(times), n, n)`.

    Raises:
        DimensionError: times do not increase, or their number differs from that of the values.
    """
    starts, stack = np.asarray(times, np.float64), np.asarray(values, np.float64)
    if starts.ndim != 1 or len(starts) != len(stack) or np.any(np.diff(starts) <= 0):
        raise DimensionError(
            f"times has shape {starts.shape} and values {stack.shape}; give one matrix for each "
            f"time, the times increasing"
        )
    return lambda t: stack[max(int(np.searchsorted(starts, t + 1e-9, side="right")) - 1, 0)]


def _integrated(order: int, dt: float, q: ArrayLike, held: bool) -> Array:
    """Q of a chain of `order` integrators per coordinate, driven by white noise of density q.

    The response of the i-th block of the state, a time s after a unit impulse, is s^p/p! with
    p = order - 1 - i.
    """
    density = np.atleast_1d(np.asarray(q, np.float64))
    if not (density >= 0).all() or not dt > 0:
        raise CovarianceError(f"q is {q} and dt {dt}; use densities of at least 0 and dt above 0")
    power = np.arange(order - 1, -1, -1)
    factorial = np.cumprod(np.maximum(np.arange(order), 1))[power]
    if held:
        gamma = dt ** (power + 1) / (factorial * (power + 1))
        block = np.outer(gamma, gamma) / dt
    else:
        total = power[:, None] + power + 1
        block = dt**total / (total * np.outer(factorial, factorial))
    return np.asarray(np.kron(block, np.diag(density)), np.float64)
