"""The belief at each instant, given everything that has arrived by then.

A late reading is fused exactly by going back: the belief before the update at the instant it
belongs to is taken from memory, and everything received since is replayed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estbench.estimators.protocol import Estimator, FilterHistory, Measurement
from estbench.inference.inbox import Inbox
from estbench.inference.innovations import Innovations, check
from estbench.inference.run_subset import ALL, RunIndex, put, some, take, within
from estbench.sensors.sampling import Delivery
from estbench.sensors.timing import Instant
from estbench.shapes import Array


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


class Fusion:
    """One estimator's way from instant to instant.

    Args:
        estimator: any object of the protocol.
        instants: the schedule.
        inbox: an empty one.
        delays: what to do about late readings.
        innovations: the recorder that is told of every update.
        past: to be filled in for a smoother.

    Attributes:
        late: per run, readings that came after the window and were not fused.
    """

    def __init__(
        self,
        estimator: Estimator,
        instants: Sequence[Instant],
        inbox: Inbox,
        delays: Delays,
        innovations: Innovations,
        past: FilterHistory | None = None,
    ):
        self._estimator, self._instants, self._inbox, self._delays = (
            estimator, instants, inbox, delays,
        )  # fmt: skip
        self._innovations, self._past = innovations, past
        self._ticks = np.array([i.tick for i in instants])
        self._memory = delays.window > 0 and delays.handling == "exact"
        self._priors: dict[int, Any] = {}
        self._controls: dict[int, Array] = {}
        self._checked: set[tuple[str, ...]] = set()
        self.late = np.zeros(innovations.runs, np.int64)

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
            rows = ALL if self._past is not None else some(self._priors[j], np.less_equal(first, j))
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

    def _update(self, k: int, belief: Any, u: Array, rows: RunIndex = ALL) -> Any:
        """The belief of some runs at instant k with all that belongs there."""
        joints = self._inbox.at(k)
        if joints:
            self._innovations.clear(k, rows)
        for layer, joint in enumerate(joints):
            came, masked = ALL, {}
            if joint.mask is not None:
                came = some(belief, np.any(joint.mask[rows], axis=-1))
                masked = {"mask": joint.mask[within(rows, came)]}
            runs = within(rows, came)
            y = joint.y[runs]
            if not len(y):
                continue
            answer = self._estimator.update(
                take(belief, came), y, u[runs], self._instants[k].end, joint.channels, **masked
            )
            if joint.channels not in self._checked:
                self._check(answer, joint.channels, len(y))
            part, innovation = answer
            belief = put(belief, came, part)
            self._innovations.put(k, layer, joint.channels, innovation, masked.get("mask"), runs)
        if self._past is not None:  # a replay writes over what it changes
            self._past.beliefs[k + 1], self._past.controls[k] = belief, u
            self._past.measurements[k + 1] = [
                Measurement(joint.y, u, joint.channels, joint.mask) for joint in joints
            ]
        return belief

    def _check(self, answer: Any, channels: tuple[str, ...], runs: int) -> None:
        """Check the first updates by these channels, up to one that fuses: a start only gathers."""
        m = sum(self._inbox.spaces[name].n for name in channels)
        started = getattr(self._estimator, "estimator", self._estimator)  # by its own name
        check(type(started).__name__, answer, runs, m)
        if np.any(answer[1].dof):
            self._checked.add(channels)

    def _forget(self, k: int) -> None:
        """Drop what no reading can reach any more."""
        if not self._memory:
            self._inbox.forget(k + 1)
            return
        oldest = int(np.searchsorted(self._ticks, self._ticks[k] - self._delays.window))
        self._inbox.forget(oldest)
        for j in [j for j in self._priors if j < oldest]:
            del self._priors[j], self._controls[j]
