"""The event loop: predict to each instant, update with what arrives, record.

An estimator is driven the same way whatever the source of truth and readings: recorded beforehand,
or stepped along because the controller sees the estimate (`simulation.sources`).
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol, cast

from estbench.estimators.beliefs import start
from estbench.estimators.protocol import Estimator, Smoother
from estbench.inference.fusion import Delays, Fusion
from estbench.inference.inbox import Inbox
from estbench.inference.innovations import Innovations
from estbench.inference.lags import BLOCK
from estbench.inference.looking_back import LookingBack
from estbench.inference.traces import Recorder, Traces
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery
from estbench.shapes import Array, Float, Keys, UInt
from estbench.spaces.blas import one_thread
from estbench.spaces.linalg import quiet
from estbench.spaces.manifold import Manifold


class Source(Protocol):
    """Where truth, control and measurements come from."""

    events: Sequence[Event]

    @property
    def x0(self) -> Float[Array, "run nx"] | None:
        """True states at the start; None where they are not known."""
        ...

    def control(self, k: int, estimate: Float[Array, "run nx"]) -> Float[Array, "run nu"]:
        """The control, held up to the end of the k-th event."""
        ...

    def advance(
        self, k: int, u: Float[Array, "run nu"]
    ) -> tuple[Float[Array, "run nx"] | None, list[Delivery]]:
        """True state at the end of the k-th event, None if it is not known, and what arrives."""
        ...


def run_filter(
    estimator: Estimator,
    space: Manifold,
    prior: tuple[Float[Array, "run nx"], Float[Array, "run n n"]],
    source: Source,
    channels: Mapping[str, Manifold],
    *,
    delays: Delays | None = None,
    keys: UInt[Keys, " run"] | None = None,
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
        prior: x̂₀ and P₀.
        source: truth, controls, readings.
        channels: channel -> the manifold of its readings, in the measurement's order.
        delays: what to do about late readings.
        keys: a random key per run for estimators whose `init` takes `keys`.
        keep_cov: whether to record full covariances.
        keep_innovations: whether to record ν and S of what was fused.
        stop: asked at every instant; True ends the loop and returns None.

    Raises:
        DimensionError: the estimator's mean or covariance has the wrong shape.
    """
    whole = followed(
        estimator, space, prior, source, channels, delays=delays, keys=keys, keep_cov=keep_cov,
        keep_innovations=keep_innovations, stop=stop,
    )  # fmt: skip
    return next(whole, None)


def followed(
    estimator: Estimator,
    space: Manifold,
    prior: tuple[Float[Array, "run nx"], Float[Array, "run n n"]],
    source: Source,
    channels: Mapping[str, Manifold],
    *,
    delays: Delays | None = None,
    keys: UInt[Keys, " run"] | None = None,
    keep_cov: bool = False,
    keep_innovations: bool = False,
    stop: Callable[[], bool] = lambda: False,
    length: int | None = None,
) -> Iterator[Traces]:
    """`run_filter`, one window of instants after the other, of which one is held at a time.

    The traces of a window begin with the last time of the one before, and end where a late reading
    can change nothing more. They are void when the next is asked for. What they say of the run
    (fault, lags, ...) is what is known so far.

    Args:
        estimator: as for `run_filter`, like all but the last.
        space: the state space of truth and estimate.
        prior: x̂₀ and P₀.
        source: truth, controls, readings.
        channels: channel -> the manifold of its readings, in the measurement's order.
        delays: what to do about late readings.
        keys: a random key per run for estimators whose `init` takes `keys`.
        keep_cov: whether to record full covariances, where one window is all.
        keep_innovations: whether to record ν and S, likewise.
        stop: asked at every instant; True ends it.
        length: of a window, instants; None is all.
    """
    mean0, cov0 = prior
    clock = Stopwatch()
    belief, events = start(estimator, mean0, cov0, keys), source.events
    delays, count = delays or Delays(), len(events)
    length = count if length is None else length
    held = min(count, length + delays.window + BLOCK)
    recorder = Recorder(estimator, space, held, len(mean0), keep_cov)
    innovations = Innovations(channels, held, len(mean0), keep_innovations)
    back = history = None
    if hasattr(estimator, "smooth"):
        ends = [event.instant.end for event in events]
        back = LookingBack(cast(Smoother, estimator), belief, ends, recorder)
        history = back.history
    fusion = Fusion(estimator, belief, Inbox(channels), delays, innovations, history)
    clock.stop()
    with quiet():
        recorder.add(0, source.x0, belief)
    for first in range(0, max(count, 1), max(length, 1)):
        with quiet(), one_thread():
            for k in range(first, min(first + length, count)):
                if stop():
                    return
                event, u = events[k], source.control(k, recorder.estimate(k))
                x, arrived = source.advance(k, u)
                clock.start()
                settled = fusion.step(event, u, arrived)
                clock.stop()
                innovations.settle(settled)
                recorder.add(k + 1, x, fusion.belief, fusion.fault)
                if back is not None:
                    clock.start()
                    back.settle(settled if k + 1 < count else k + 2)
                    clock.stop()
        final = first + length >= count
        known = count if final else innovations.settled
        counted = {"late": fusion.late, "cpu_time": clock.cpu_time}
        yield recorder.traces(innovations.traces(known, final) | counted, known + 1)
        if not final:
            recorder.drop(known)
            innovations.drop(known)


class Stopwatch:
    """CPU time of this thread while the watch runs; it runs from the start.

    The thread's CPU clock is a call of the kernel, which may take tens of microseconds. It is read
    at the beginning and at the end; the share of the time in between is that of the wall clock.
    """

    def __init__(self) -> None:
        self._cpu, self._running = time.thread_time(), 0.0
        self._began = self._started = time.perf_counter()

    def start(self) -> None:
        """Go on."""
        self._started = time.perf_counter()

    def stop(self) -> None:
        """Pause."""
        self._running += time.perf_counter() - self._started

    @property
    def cpu_time(self) -> float:
        """Seconds of CPU time so far."""
        wall = time.perf_counter() - self._began
        return (time.thread_time() - self._cpu) * min(self._running / wall, 1.0) if wall else 0.0
