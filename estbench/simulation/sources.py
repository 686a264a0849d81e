"""Where truth, controls and readings of a batch come from: recorded beforehand, or stepped along.

Arrays are time-major `(instant, run, ...)`: the event loop works on one instant of all runs.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from estbench.estimators.beliefs import Fault
from estbench.inference.traces import Traces
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery
from estbench.sensors.timing import Instant
from estbench.shapes import Array, Bool, Float, Mask
from estbench.simulation.controllers import Controller
from estbench.simulation.truth import Simulator


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What happened in some runs.

    Attributes:
        x: true states, the first at t = 0; NaN from where MuJoCo failed, or from the first control
            that a failed reference estimator would have had to give.
        u: controls, held up to the instant.
        deliveries: what arrived at each instant.
        lost: runs whose reference estimator failed; None without one.
    """

    x: Float[Array, "time run nx"]
    u: Float[Array, "time-1 run nu"]
    deliveries: list[list[Delivery]]
    lost: Bool[Mask, " run"] | None = None


class Events(Sequence[Event]):
    """The instants as events of all rows, made when they are asked for; the last one is kept."""

    def __init__(self, instants: Sequence[Instant]):
        self._instants = instants
        self._place, self._event = len(instants), Event(0, Instant(0.0, 0.0, 0, (), False, 0))

    def __len__(self) -> int:
        return len(self._instants)

    @overload
    def __getitem__(self, k: int) -> Event: ...
    @overload
    def __getitem__(self, k: slice) -> list[Event]: ...
    def __getitem__(self, k: int | slice) -> Event | list[Event]:
        if isinstance(k, slice):
            return [Event(instant.tick, instant) for instant in self._instants[k]]
        if k != self._place:
            instant = self._instants[k]
            self._place, self._event = k, Event(instant.tick, instant)
        return self._event


class Recorded:
    """A trajectory that was simulated beforehand, the same for every estimator."""

    def __init__(self, instants: Sequence[Instant], trajectory: Trajectory):
        self.events: Sequence[Event] = Events(instants)
        self.x0 = trajectory.x[0]
        self._trajectory = trajectory

    def control(self, k: int, estimate: Float[Array, "run nx"]) -> Float[Array, "run nu"]:
        """The recorded control."""
        return self._trajectory.u[k]

    def advance(
        self, k: int, u: Float[Array, "run nu"]
    ) -> tuple[Float[Array, "run nx"], list[Delivery]]:
        """The recorded state and readings."""
        return self._trajectory.x[k + 1], self._trajectory.deliveries[k]


class Live:
    """Robots driven by what a controller sees: same random numbers, another trajectory for each.

    Args:
        simulator: the true robots at their start.
        instants: of the runs.
        controller: asked at every instant that says so.
        period: time between control updates, s.
    """

    def __init__(
        self,
        simulator: Simulator,
        instants: Sequence[Instant],
        controller: Controller,
        period: float,
    ):
        self.events: Sequence[Event] = Events(instants)
        self.x0 = simulator.x
        self._simulator, self._controller, self._period = simulator, controller, period
        self._u = np.empty(0)

    def control(self, k: int, estimate: Float[Array, "run nx"]) -> Float[Array, "run nu"]:
        """The controller's answer to the states that it sees."""
        instant = self.events[k].instant
        if instant.control:
            step = round(instant.start / self._period)
            self._u = self._controller(step, instant.start, finite(estimate, self.x0))
        return self._u

    def advance(
        self, k: int, u: Float[Array, "run nu"]
    ) -> tuple[Float[Array, "run nx"], list[Delivery]]:
        """Step the robots."""
        arrived = self._simulator.advance(self.events[k], u)
        return self._simulator.x, arrived


class Noting:
    """A live source that notes what happens, while an estimator or nobody follows it."""

    def __init__(self, live: Live):
        self.events, self.x0 = live.events, live.x0
        self._live = live
        self._x = np.empty((len(live.events) + 1, *live.x0.shape))
        self._x[0] = live.x0
        self._u = np.empty(0)
        self._deliveries: list[list[Delivery]] = []

    def control(self, k: int, estimate: Float[Array, "run nx"]) -> Float[Array, "run nu"]:
        """The controller's answer to the states that it sees."""
        return self._live.control(k, estimate)

    def advance(
        self, k: int, u: Float[Array, "run nu"]
    ) -> tuple[Float[Array, "run nx"], list[Delivery]]:
        """Step the robots, and note it."""
        x, arrived = self._live.advance(k, u)
        if not k:
            self._u = np.empty((len(self.events), *u.shape))
        self._x[k + 1], self._u[k] = x, u
        self._deliveries.append(arrived)
        return x, arrived

    def trajectory(self) -> Trajectory:
        """What happened."""
        return Trajectory(self._x, self._u, self._deliveries)


def record(source: Live) -> Trajectory:
    """Run robots through their schedule under a controller that sees the true state."""
    noting, x = Noting(source), source.x0
    for k in range(len(source.events)):
        x, _ = noting.advance(k, noting.control(k, x))
    return noting.trajectory()


def finite(x: Float[Array, "run nx"], fallback: Float[Array, "run nx"]) -> Float[Array, "run nx"]:
    """X with the rows that are not finite replaced: a failed run must not reach a controller."""
    bad = ~np.isfinite(x).all(axis=-1)
    return np.where(bad[:, None], fallback, x) if bad.any() else x


class Passing:
    """A trajectory of which two windows are known at a time: the same for all who follow in step.

    Args:
        live: the robots at their start.
        length: of a window, instants.

    Attributes:
        now: the window that is followed; its first state is the last of the one before.
        ahead: the window after it; None at the end.
        ended: the first time, by its index, at which a run has no truth, -1 for none `(run,)`.
        lost: of these the runs whose reference estimator failed `(run,)`.
        reference: traces of the estimator whose estimate the controller sees, window after window,
            on `robots`; None if the controller sees the true state.
        robots: the source of that estimator.
    """

    def __init__(self, live: Live, length: int):
        self.events, self.x0 = live.events, live.x0
        self.ended, self.lost = np.full(len(live.x0), -1), np.zeros(len(live.x0), bool)
        self.robots, self._length = _Window(live), length
        self.reference: Iterator[Traces] | None = None
        self._first = self._next = self._simulated = 0  # instants
        self.now = Trajectory(live.x0[None], np.empty((0, len(live.x0), 0)), [])
        self.ahead: Trajectory | None = self.now

    def forward(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Go on to the next window; False when stopped."""
        if not self._simulated and not self._simulate(stop):
            return False
        assert self.ahead is not None  # before the end
        self.now, self._first, self._next = self.ahead, self._next, self._simulated
        return self._simulate(stop)

    def _simulate(self, stop: Callable[[], bool]) -> bool:
        """Simulate the window after those that are known; False when stopped."""
        first, last = self._simulated, min(self._simulated + self._length, len(self.events))
        if first == last:
            self.ahead = None
            return True
        traces, robots = None, self.robots
        if self.reference is None:
            for k in range(first, last):
                if stop():
                    return False
                robots.advance(k, robots.control(k, robots.x[-1]))
        elif (traces := next(self.reference, None)) is None:
            return False
        window = robots.take()
        if traces is not None:
            self.lost = (traces.fault != Fault.NONE) & (traces.fault != Fault.TRUTH)
            for run in np.flatnonzero(self.lost):
                window.x[max(traces.fault_step[run] + 1 - first, 0) :, run] = np.nan
        gone = ~np.isfinite(window.x).all(axis=-1)
        new = gone.any(axis=0) & (self.ended < 0)
        self.ended[new] = first + gone.argmax(axis=0)[new]
        self.ahead, self._simulated = window, last
        return True

    def control(self, k: int, estimate: Float[Array, "run nx"]) -> Float[Array, "run nu"]:
        """The control, of the window that is known."""
        return self.now.u[k - self._first]

    def advance(
        self, k: int, u: Float[Array, "run nu"]
    ) -> tuple[Float[Array, "run nx"], list[Delivery]]:
        """The state and the readings, of the window that is known."""
        place = k - self._first
        return self.now.x[place + 1], self.now.deliveries[place]


class _Window:
    """A live source that notes what happens since it was asked."""

    def __init__(self, live: Live):
        self.events, self.x0, self._live = live.events, live.x0, live
        self.x, self._u, self._deliveries = [live.x0], list[Array](), list[list[Delivery]]()

    def control(self, k: int, estimate: Float[Array, "run nx"]) -> Float[Array, "run nu"]:
        """The controller's answer to the states that it sees."""
        return self._live.control(k, estimate)

    def advance(
        self, k: int, u: Float[Array, "run nu"]
    ) -> tuple[Float[Array, "run nx"], list[Delivery]]:
        """Step the robots, and note it."""
        x, arrived = self._live.advance(k, u)
        self.x.append(x)
        self._u.append(u)
        self._deliveries.append(arrived)
        return x, arrived

    def take(self) -> Trajectory:
        """What has happened; the next begins with its last state."""
        found = Trajectory(np.stack(self.x), np.stack(self._u), self._deliveries)
        self.x, self._u, self._deliveries = self.x[-1:], [], []
        return found
