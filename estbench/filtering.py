"""The event loop: predict to each instant, update with what arrives, record.

An estimator is driven the same way whether the truth was recorded beforehand (`Recorded`) or is
stepped beside it because the controller sees the estimate (`Live`).

A late reading is fused exactly by going back: the belief before the update at the instant it
belongs to is taken from memory, and everything received since is replayed.
"""

import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from estbench.controllers import Controller
from estbench.errors import DimensionError
from estbench.estimators.base import Estimator, Measurement, Passage, Smoother
from estbench.inbox import Inbox
from estbench.lags import Lags
from estbench.manifold import Manifold
from estbench.partial import ALL, Rows, put, some, take, within
from estbench.readings import Delivery
from estbench.timing import Instant
from estbench.traces import Recorder, Traces
from estbench.truth import Simulator, Trajectory, finite

Array = NDArray[np.float64]


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


@dataclass(frozen=True)
class Delays:
    """What a filter does about late readings.

    Attributes:
        handling: `exact` goes back and replays, `naive` fuses a reading as if it were current.
        window: how far exact handling can go back, in physics steps; an older reading is counted
            and not fused.
        believed: channel -> latency that the filter assumes, in physics steps; a channel that is
            not listed carries the time it was taken.
        nominal: channels whose readings carry the time at which they were due.
    """

    handling: Literal["exact", "naive"] = "exact"
    window: int = 0
    believed: Mapping[str, int] = field(default_factory=dict)
    nominal: frozenset[str] = frozenset()


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
        stop: asked at every instant; True ends the loop and returns None.

    Raises:
        DimensionError: the estimator's mean or covariance has the wrong shape.
    """
    mean0, cov0 = prior
    began = time.thread_time()
    random = keys is not None and "keys" in inspect.signature(estimator.init).parameters
    belief = estimator.init(mean0, cov0, **({"keys": keys} if random else {}))
    recorder = Recorder(estimator, space, len(source.instants), len(mean0), keep_cov)
    fusion = _Fusion(estimator, source.instants, Inbox(channels), delays or Delays(), len(mean0))
    if hasattr(estimator, "smooth"):
        fusion.past = _passage(belief, [i.end for i in source.instants])
    cpu_time = time.thread_time() - began
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
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
        if fusion.past is not None:
            began = time.thread_time()
            smoothed = cast(Smoother, estimator).smooth(fusion.past)
            cpu_time += time.thread_time() - began
            if len(smoothed) != len(recorder.truth):
                raise DimensionError(
                    f"{type(estimator).__name__}: smooth returned {len(smoothed)} beliefs; "
                    f"expected {len(recorder.truth)}, one a time and one for the start"
                )
            for k, belief in enumerate(smoothed):
                recorder.add(k, recorder.truth[k], belief)
    return recorder.traces(fusion.counted() | {"cpu_time": cpu_time})


class _Fusion:
    """The belief at each instant given everything that has arrived by then."""

    def __init__(
        self,
        estimator: Estimator,
        instants: Sequence[Instant],
        inbox: Inbox,
        delays: Delays,
        runs: int,
    ):
        self._estimator, self._instants, self._inbox, self._delays = (
            estimator, instants, inbox, delays,
        )  # fmt: skip
        self._ticks = np.array([i.tick for i in instants])
        self._memory = delays.window > 0 and delays.handling == "exact"
        self._priors: dict[int, Any] = {}
        self._controls: dict[int, Array] = {}
        self.nis = np.full((len(instants), runs), np.nan)
        self.dof = np.zeros((len(instants), runs), np.int64)
        self.late = np.zeros(runs, np.int64)
        self.whiteness = Lags(runs, {name: s.n for name, s in inbox.spaces.items()})
        self.past: Passage | None = None

    def counted(self) -> dict[str, NDArray[Any]]:
        """What `Traces` says of innovations and of late readings."""
        lags, lag_terms = self.whiteness.sums()
        return {
            "nis": self.nis, "dof": self.dof, "lags": lags, "lag_terms": lag_terms,
            "late": self.late,
        }  # fmt: skip

    def step(self, k: int, belief: Any, u: Array, arrived: list[Delivery]) -> Any:
        """The belief at the end of instant k, given that at its start."""
        first = np.full(len(self.late), k)
        for delivery in arrived:
            instant = self._place(k, delivery)
            if instant is None:
                self.late += 1 if delivery.mask is None else delivery.mask
                continue
            self._inbox.add(instant, delivery)
            came = ALL if delivery.mask is None else delivery.mask
            first[came] = np.minimum(first[came], instant)
        belief = self._predict(k, self._replayed(k, belief, first), u)
        if self._memory:
            self._controls[k], self._priors[k] = u, belief
        belief = self._update(k, belief, u)
        self._forget(k)
        return belief

    def _replayed(self, k: int, belief: Any, first: NDArray[np.int64]) -> Any:
        """The belief at the start of instant k with all that came late.

        Each run goes back no further than it must: to the instant `first` `(run,)`.
        """
        oldest = int(first.min())
        rows, part = ALL, belief
        for j in range(oldest, k):
            u = self._controls[j]
            if j > oldest:
                part = self._predict(j, part, u[rows])
                self._priors[j] = put(self._priors[j], rows, part)
            rows = ALL if self.past is not None else some(self._priors[j], np.less_equal(first, j))
            part = self._update(j, take(self._priors[j], rows), u, rows)
        return put(belief, rows, part)

    def _place(self, k: int, delivery: Delivery) -> int | None:
        """The instant at which the filter fuses a reading that arrives at k, None if too late."""
        if self._delays.handling == "naive":
            return k
        nominal = delivery.channel in self._delays.nominal
        instant = delivery.due if nominal else delivery.taken
        if delivery.channel in self._delays.believed:
            tick = self._ticks[k] - self._delays.believed[delivery.channel]
            instant = int(np.searchsorted(self._ticks, tick, "right")) - 1
        if instant < 0 or self._ticks[k] - self._ticks[instant] > self._delays.window:
            return None
        return min(instant, k)

    def _predict(self, k: int, belief: Any, u: Array) -> Any:
        instant = self._instants[k]
        return self._estimator.predict(belief, u, instant.start, instant.end - instant.start)

    def _update(self, k: int, belief: Any, u: Array, rows: Rows = ALL) -> Any:
        """The belief of some runs at instant k with all that belongs there."""
        joints = self._inbox.at(k)
        if joints:
            self.nis[k, rows], self.dof[k, rows] = 0.0, 0
        for layer, joint in enumerate(joints):
            came, masked = ALL, {}
            if joint.mask is not None:
                came = some(belief, np.any(joint.mask[rows], axis=-1))
                masked = {"mask": joint.mask[within(rows, came)]}
            runs = within(rows, came)
            y = joint.y[runs]
            if not len(y):
                continue
            part, innovation = self._estimator.update(
                take(belief, came), y, u[runs], self._instants[k].end, joint.channels, **masked
            )
            belief = put(belief, came, part)
            self.nis[k, runs] += innovation.nis
            self.dof[k, runs] += innovation.dof
            if np.size(innovation.white):
                mask = masked.get("mask")
                self.whiteness.put(k, layer, joint.channels, innovation.white, mask, runs)
        if joints:
            self.nis[k, self.dof[k] == 0] = np.nan
        if self.past is not None:  # a replay writes over what it changes
            self.past.beliefs[k + 1], self.past.controls[k] = belief, u
            self.past.measurements[k + 1] = [
                Measurement(joint.y, u, joint.channels, joint.mask) for joint in joints
            ]
        return belief

    def _forget(self, k: int) -> None:
        """Drop what no reading can reach any more."""
        if not self._memory:
            self._inbox.forget(k + 1)
            return
        oldest = int(np.searchsorted(self._ticks, self._ticks[k] - self._delays.window))
        self._inbox.forget(oldest)
        for j in [j for j in self._priors if j < oldest]:
            del self._priors[j], self._controls[j]


def _passage(start: Any, ends: list[float]) -> Passage:
    """One to be filled in."""
    count = len(ends)
    return Passage([start] * (count + 1), [np.empty(0)] * count, [0.0, *ends], [[]] * (count + 1))
