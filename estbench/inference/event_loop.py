"""The event loop: predict to each instant, update with what arrives, record.

An estimator is driven the same way whether the truth was recorded beforehand (`Recorded`) or is
stepped beside it because the controller sees the estimate (`Live`).
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from estbench.errors import DimensionError
from estbench.estimators.beliefs import start
from estbench.estimators.protocol import Estimator, FilterHistory, Smoother
from estbench.inference.fusion import Delays, Fusion
from estbench.inference.inbox import Inbox
from estbench.inference.innovations import Innovations
from estbench.inference.traces import Recorder, Traces
from estbench.sensors.sampling import Delivery
from estbench.sensors.timing import Instant
from estbench.shapes import Array
from estbench.simulation.controllers import Controller
from estbench.simulation.truth import Simulator, Trajectory, finite
from estbench.spaces.linalg import quiet
from estbench.spaces.manifold import Manifold


class Source(Protocol):
    """Where truth, control and measurements come from."""

    instants: Sequence[Instant]
    x0: Array

    def control(self, k: int, estimate: Array) -> Array:
        """U `(run, nu)` held up to the end of instant k."""
        ...

    def advance(self, k: int, u: Array) -> tuple[Array, list[Delivery]]:
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

    def advance(self, k: int, u: Array) -> tuple[Array, list[Delivery]]:
        """The recorded state and readings."""
        return self._trajectory.x[k + 1], self._trajectory.deliveries[k]


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

    def advance(self, k: int, u: Array) -> tuple[Array, list[Delivery]]:
        """Step the robot."""
        self._x, arrived = self._simulator.step(k, self._x, u)
        return self._x, arrived


def run_filter(
    estimator: Estimator,
    space: Manifold,
    prior: tuple[Array, Array],
    source: Source,
    channels: Mapping[str, Manifold],
    *,
    delays: Delays | None = None,
    keys: NDArray[np.uint64] | None = None,
    keep_cov: bool = False,
    keep_innovations: bool = False,
    stop: Callable[[], bool] = lambda: False,
) -> Traces | None:
    """Drive an estimator through a source and compare it with the truth at every instant.

    One that has the method `smooth` (see `Smoother`) is compared after it has looked back; its
    innovations, and what a controller saw, are those of its filter.

    What arrives in few runs is fused in those alone, if the belief is a mean, a covariance (or its
    factor) and faults and nothing else: such an estimator, and its model, must not tell runs apart
    by their place in the batch.

    Args:
        estimator: any object of the protocol.
        space: the state space of truth and estimate.
        prior: x̂₀ `(run, nx)` and P₀ `(run, n, n)`.
        source: truth, controls, readings.
        channels: channel -> the manifold of its readings, in the measurement's order.
        delays: what to do about late readings.
        keys: a random key a run for estimators whose `init` takes `keys`.
        keep_cov: whether to record full covariances.
        keep_innovations: whether to record ν and S of what was fused.
        stop: asked at every instant; True ends the loop and returns None.

    Raises:
        DimensionError: the estimator's mean or covariance has the wrong shape.
    """
    mean0, cov0 = prior
    began = time.thread_time()
    belief = start(estimator, mean0, cov0, keys)
    recorder = Recorder(estimator, space, len(source.instants), len(mean0), keep_cov)
    innovations = Innovations(channels, len(source.instants), len(mean0), keep_innovations)
    past = None
    if hasattr(estimator, "smooth"):
        past = _passage(belief, [i.end for i in source.instants])
    inbox, delays = Inbox(channels), delays or Delays()
    fusion = Fusion(estimator, source.instants, inbox, delays, innovations, past)
    cpu_time = time.thread_time() - began
    with quiet():
        recorder.add(0, source.x0, belief)
        for k in range(len(source.instants)):
            if stop():
                return None
            u = source.control(k, recorder.mean[k])
            x, arrived = source.advance(k, u)
            began = time.thread_time()
            belief = fusion.step(k, belief, u, arrived)
            cpu_time += time.thread_time() - began
            recorder.add(k + 1, x, belief)
        if past is not None:
            began = time.thread_time()
            smoothed = cast(Smoother, estimator).smooth(past)
            cpu_time += time.thread_time() - began
            if len(smoothed) != len(recorder.truth):
                raise DimensionError(
                    f"{type(estimator).__name__}: smooth returned {len(smoothed)} beliefs; "
                    f"expected {len(recorder.truth)}, one a time and one for the start"
                )
            for k, belief in enumerate(smoothed):
                recorder.add(k, recorder.truth[k], belief)
    return recorder.traces(innovations.traces() | {"late": fusion.late, "cpu_time": cpu_time})


def _passage(start: Any, ends: list[float]) -> FilterHistory:
    """One to be filled in."""
    count = len(ends)
    return FilterHistory(
        [start] * (count + 1), [np.empty(0)] * count, [0.0, *ends], [[]] * (count + 1)
    )
