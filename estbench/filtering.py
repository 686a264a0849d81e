"""The event loop: predict to each instant, update with what arrives, record.

An estimator is driven the same way whether the truth was recorded beforehand (`Recorded`) or is
stepped beside it because the controller sees the estimate (`Live`).
"""

import inspect
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from estbench.controllers import Controller
from estbench.errors import DimensionError
from estbench.estimators.base import Estimator, Fault, Innovation
from estbench.linalg import quadratic_form
from estbench.manifold import Manifold
from estbench.sensors import Instant
from estbench.truth import Simulator, Trajectory, finite

Array = NDArray[np.float64]


class Source(Protocol):
    """Where truth, control and measurements come from."""

    instants: Sequence[Instant]
    x0: Array

    def control(self, k: int, estimate: Array) -> Array:
        """U `(run, nu)` held up to the end of instant k."""
        ...

    def advance(self, k: int, u: Array) -> tuple[Array, Array | None]:
        """True state `(run, nx)` at the end of instant k and what arrives then."""
        ...


class Recorded:
    """A trajectory that was simulated beforehand, the same for every estimator."""

    def __init__(self, instants: Sequence[Instant], trajectory: Trajectory):
        self.instants = instants
        self.x0 = trajectory.x[0]
        self._trajectory = trajectory

    def control(self, k: int, estimate: Array) -> Array:
        """The recorded control."""
        return self._trajectory.u[k]

    def advance(self, k: int, u: Array) -> tuple[Array, Array | None]:
        """The recorded state and measurement."""
        return self._trajectory.x[k + 1], self._trajectory.y[k]


class Live:
    """The robot driven by the estimate: same random numbers, another trajectory an estimator."""

    def __init__(self, simulator: Simulator, controller: Controller, frame_time: float):
        self.instants = simulator.instants
        self.x0 = simulator.x0
        self._simulator, self._controller, self._frame_time = simulator, controller, frame_time
        self._x, self._u = simulator.x0, np.empty(0)

    def control(self, k: int, estimate: Array) -> Array:
        """The controller's answer to the estimate."""
        instant = self.instants[k]
        if instant.control:
            step = round(instant.start / self._frame_time)
            self._u = self._controller(step, instant.start, finite(estimate, self.x0))
        return self._u

    def advance(self, k: int, u: Array) -> tuple[Array, Array | None]:
        """Step the robot."""
        self._x, y = self._simulator.step(k, self._x, u)
        return self._x, y


@dataclass(frozen=True, eq=False)
class Traces:
    """One estimator over some runs, time-major; index 0 is the prior at t = 0.

    Attributes:
        truth: x `(K + 1, run, nx)`.
        mean: x̂ `(K + 1, run, nx)`.
        error: x ⊖ x̂ `(K + 1, run, n)`.
        std: sqrt of P's diagonal `(K + 1, run, n)`.
        nees: `(K + 1, run)`.
        nis: `(K, run)`, NaN where nothing arrived.
        dof: `(K, run)`, how many components arrived.
        lag_one: per run, the mean over its updates of ν̃ₖ·ν̃ₖ₋₁/m with whitened innovations ν̃.
        fault: `Fault` a run.
        fault_step: index of the instant at which it failed, -1 for none.
        cpu_time: seconds of one core spent in predict and update, all runs together.
        cov: P `(K + 1, run, n, n)` when asked for, else None.
    """

    truth: Array
    mean: Array
    error: Array
    std: Array
    nees: Array
    nis: Array
    dof: NDArray[np.int64]
    lag_one: Array
    fault: NDArray[np.uint8]
    fault_step: NDArray[np.int64]
    cpu_time: float
    cov: Array | None = None


def run_filter(
    estimator: Estimator,
    space: Manifold,
    prior: tuple[Array, Array],
    source: Source,
    *,
    keys: NDArray[np.uint64] | None = None,
    keep_cov: bool = False,
    stop: Callable[[], bool] = lambda: False,
) -> Traces | None:
    """Drive an estimator through a source and compare it with the truth at every instant.

    Args:
        estimator: any object of the protocol.
        space: the state space of truth and estimate.
        prior: x̂₀ `(run, nx)` and P₀ `(run, n, n)`.
        source: truth, controls, measurements.
        keys: a random key a run for estimators whose `init` takes `keys`.
        keep_cov: whether to record full covariances.
        stop: asked at every instant; True ends the loop and returns None.

    Raises:
        DimensionError: the estimator's mean or covariance has the wrong shape.
    """
    clock = time.thread_time
    mean0, cov0 = prior
    count, runs, n = len(source.instants), len(mean0), space.n
    began = clock()
    random = keys is not None and "keys" in inspect.signature(estimator.init).parameters
    belief = estimator.init(mean0, cov0, **({"keys": keys} if random else {}))
    cpu_time = clock() - began
    truth = np.empty((count + 1, runs, space.nx))
    mean = np.empty_like(truth)
    error, std = (np.empty((count + 1, runs, n)) for _ in range(2))
    nees = np.empty((count + 1, runs))
    cov = np.empty((count + 1, runs, n, n)) if keep_cov else None
    nis, dof = np.full((count, runs), np.nan), np.zeros((count, runs), np.int64)
    fault, fault_step = np.zeros(runs, np.uint8), np.full(runs, -1)
    whiteness = _LagOne(runs)

    def record(index: int, x: Array, belief: Any) -> None:
        m, P = estimator.mean(belief), estimator.cov(belief)
        if m.shape != (runs, space.nx) or P.shape != (runs, n, n):
            raise DimensionError(
                f"{type(estimator).__name__}: mean has shape {m.shape} and cov {P.shape}; expected "
                f"{(runs, space.nx)} and {(runs, n, n)}"
            )
        truth[index], mean[index] = x, m
        error[index] = space.minus(x, m)
        variance = np.diagonal(P, axis1=-2, axis2=-1)
        std[index] = np.sqrt(np.where(variance > 0, variance, np.nan))
        nees[index] = quadratic_form(P, error[index])
        if cov is not None:
            cov[index] = P
        broken = ~np.isfinite(nees[index])
        if broken.any():
            reason = getattr(belief, "fault", None)
            reason = np.full(runs, Fault.STATE) if reason is None else reason
            new = broken & (fault == Fault.NONE)
            indefinite = np.isfinite(P).all(axis=(-2, -1)) & np.isfinite(m).all(axis=-1)
            code = np.where(reason > 0, reason, np.where(indefinite, Fault.COVARIANCE, Fault.STATE))
            code = np.where(np.isfinite(x).all(axis=-1), code, Fault.TRUTH)
            fault[new], fault_step[new] = code[new], index

    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        record(0, source.x0, belief)
        for k, instant in enumerate(source.instants):
            if stop():
                return None
            u = source.control(k, mean[k])
            x, y = source.advance(k, u)
            began = clock()
            belief = estimator.predict(belief, u, instant.start, instant.end - instant.start)
            if y is not None:
                belief, innovation = estimator.update(belief, y, u, instant.end, instant.channels)
                nis[k], dof[k] = innovation.nis, innovation.dof
                whiteness.add(instant.channels, innovation)
            cpu_time += clock() - began
            record(k + 1, x, belief)
    return Traces(
        truth, mean, error, std, nees, nis, dof, whiteness.mean(), fault, fault_step, cpu_time, cov
    )


class _LagOne:
    """Running mean of the product of successive whitened innovations of the same channels."""

    def __init__(self, runs: int):
        self._last: dict[tuple[str, ...], Array] = {}
        self._sum, self._count = np.zeros(runs), 0

    def add(self, channels: tuple[str, ...], innovation: Innovation) -> None:
        white = innovation.white
        if white.shape[-1] and channels in self._last:
            self._sum += (white * self._last[channels]).mean(axis=-1)
            self._count += 1
        self._last[channels] = white

    def mean(self) -> Array:
        return self._sum / self._count if self._count else np.full(len(self._sum), np.nan)
