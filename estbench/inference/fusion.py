"""The belief after each event, given everything that has arrived by then.

A late reading is fused exactly by going back: the belief before the update at the event it belongs
to is taken from memory, and everything received since is replayed (Bar-Shalom, Li & Kirubarajan
2001, sec. 6.4).
"""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from estbench.estimators.protocol import Estimator, FilterHistory, Measurement
from estbench.inference.answers import Answers, kept
from estbench.inference.inbox import Inbox
from estbench.inference.innovations import InnovationLog
from estbench.inference.run_subset import ALL, RunIndex, put, some, take, within
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery, divided
from estbench.shapes import Array, Bool, Faults, Float, Ints, Mask
from estbench.spaces.selection import select


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


@dataclass(eq=False)
class _Step:
    """One event: the controls, the belief before its updates, and rows that began before it."""

    event: Event
    u: Array
    prior: Any
    began: list[tuple[Mask, Any]]


class Fusion:
    """One estimator's way from event to event, on rows of which any may begin anew.

    Args:
        estimator: any object of the protocol.
        belief: of all rows at the start.
        inbox: an empty one.
        delays: what to do about late readings.
        log: the recorder that is told of every update.
        history: to be filled in for a smoother.

    Attributes:
        belief: of all rows, now.
        late: readings of each row that came after the window and were not fused `(row,)`.
        fault: `Fault` of each row that the estimator's innovations have shown; None for none.
    """

    def __init__(
        self,
        estimator: Estimator,
        belief: Any,
        inbox: Inbox,
        delays: Delays,
        log: InnovationLog,
        history: FilterHistory | None = None,
    ):
        self.belief = belief
        self._estimator, self._inbox, self._delays = estimator, inbox, delays
        self._log, self._history = log, history
        self._memory = delays.window > 0 and delays.handling == "exact"
        self._stamped = delays.handling == "exact" and not (delays.believed or delays.nominal)
        self._steps: list[_Step] = []  # the last of them, up to the window
        self._count = 0  # events so far
        self._began: list[tuple[Mask, Any]] = []
        self._start = np.zeros(log.rows, np.int64)  # the first event of each row's episode
        self._answers = Answers(estimator)
        self._widths: dict[tuple[str, ...], int] = {}
        self.fault: Faults | None = None
        self.late = np.zeros(log.rows, np.int64)

    def restart(self, rows: Bool[Mask, " row"], fresh: Any) -> None:
        """Rows begin anew: what they had is forgotten.

        Args:
            rows: `(row,)`.
            fresh: a belief of all rows, of which those of the mask are taken.

        Raises:
            SelectionError: the belief cannot be taken apart by rows; nothing has changed.
        """
        self.belief = select(rows, fresh, self.belief)
        self._start[rows], self.late[rows] = self._count, 0
        if self.fault is not None:
            self.fault[rows] = 0
        if self._memory:
            self._began.append((rows, fresh))

    def step(self, event: Event, u: Float[Array, "row nu"], arrived: Sequence[Delivery]) -> int:
        """Go on to the end of an event under controls u `(row, nu)`; fuse what arrives there.

        Returns:
            The number of the first event that may be updated again.
        """
        k = self._count
        first: Ints | None = None
        for delivery in arrived if self._stamped else divided(arrived):
            tick = delivery.taken if self._stamped else self._stamp(event, delivery)
            if isinstance(tick, int) and tick >= event.tick:
                self._inbox.add(k, delivery)
                continue
            first = np.full(len(self.late), k) if first is None else first
            self._file(k, event, tick, delivery, first)
        oldest = k if first is None else int(first.min())
        if first is not None and oldest < k:
            self.belief = self._replayed(k, oldest, first)
        self.belief = self._predict(event, self.belief, u)
        self._count += 1
        if not self._memory:
            self.belief = self._update(k, event, u, self.belief)
            self._inbox.clear()
            return self._count
        self._steps.append(_Step(event, u, self.belief, self._began))
        self._began = []
        self.belief = self._update(k, event, u, self.belief)
        return self._forget(event.tick)

    def _stamp(self, event: Event, delivery: Delivery) -> int | Ints:
        """The tick to which the filter thinks the readings of one channel belong.

        `(row,)` where the rows differ.
        """
        (channel,), delays = delivery.channels, self._delays
        if delays.handling == "naive":
            return event.tick
        if channel in delays.believed:
            return event.tick - delays.believed[channel]
        return delivery.due if channel in delays.nominal else delivery.taken

    def _file(
        self, k: int, event: Event, tick: int | Ints, delivery: Delivery, first: Ints
    ) -> None:
        """Put a late delivery where it is to be fused, and note what it goes back to `(row,)`."""
        if isinstance(tick, int):
            number = self._last(k, event, tick)
            if number < 0 or not self._began_after(number):
                self._add(number, delivery, delivery.mask, first)
                return
            tick = np.full(len(first), tick)
        place = self._last_of_rows(k, event, tick)
        came = np.ones(len(first), bool) if delivery.mask is None else delivery.mask
        for number in np.unique(place[came]).tolist():
            self._add(number, delivery, came & (place == number), first)

    def _add(self, number: int, delivery: Delivery, mask: Mask | None, first: Ints) -> None:
        if number < 0:
            self.late += 1 if mask is None else mask
            return
        self._inbox.add(number, delivery._replace(mask=mask))
        came = ALL if mask is None else mask
        first[came] = np.minimum(first[came], number)

    def _last(self, k: int, event: Event, tick: int) -> int:
        """The last event that ends at a tick or before, -1 where that is beyond the window."""
        steps = self._steps
        place = bisect_right(steps, tick, key=lambda step: step.event.tick) - 1
        if place < 0 or event.tick - steps[place].event.tick > self._delays.window:
            return -1
        return k - len(steps) + place

    def _began_after(self, number: int) -> bool:
        """Whether rows have begun anew, or gone on by themselves, since an event."""
        return bool((self._start > number).any()) or any(
            step.event.rows is not None for step in self._steps
        )

    def _last_of_rows(self, k: int, event: Event, tick: Ints) -> Ints:
        """As `_last`, of the events of each row's own episode `(row,)`."""
        out = np.where(tick >= event.tick, k, -1)
        for back, step in enumerate(reversed(self._steps), 1):
            if event.tick - step.event.tick > self._delays.window:
                break
            fits = (out < 0) & (step.event.tick <= tick) & (k - back >= self._start)
            out[fits if step.event.rows is None else fits & step.event.rows] = k - back
        return out

    def _replayed(self, k: int, oldest: int, first: Ints) -> Any:
        """The belief before the k-th event with all that came late.

        Each row goes back no further than it must: to the event `first` `(row,)`.
        """
        rows, part = ALL, self.belief
        for j in range(oldest, k):
            step = self._steps[j - k]
            if j > oldest:
                part = self._predict(step.event, self._begun(part, step.began, rows), step.u, rows)
                step.prior = put(step.prior, rows, part)
            everyone = self._history is not None
            rows = ALL if everyone else some(step.prior, np.less_equal(first, j))
            part = self._update(j, step.event, step.u, take(step.prior, rows), rows)
        return put(self.belief, rows, self._begun(part, self._began, rows))

    def _begun(self, part: Any, began: list[tuple[Mask, Any]], rows: RunIndex) -> Any:
        """The belief of some rows, of which those that began anew are as they began."""
        for mask, fresh in began:
            part = select(mask[rows], take(fresh, rows), part)
        return part

    def _predict(self, event: Event, belief: Any, u: Array, rows: RunIndex = ALL) -> Any:
        """The belief of some rows at the end of an event; of those that do not go on, as it was."""
        instant = event.instant
        start, dt = instant.start, instant.end - instant.start
        if not dt:  # readings of the start of a log
            return belief
        if event.rows is None:
            return self._estimator.predict(belief, u[rows], start, dt)
        going = event.rows[rows]
        if not going.any():
            return belief
        few = some(belief, going)
        moved = self._estimator.predict(take(belief, few), u[within(rows, few)], start, dt)
        return select(going, moved, belief) if isinstance(few, slice) else put(belief, few, moved)

    def _update(self, k: int, event: Event, u: Array, belief: Any, rows: RunIndex = ALL) -> Any:
        """The belief of some rows at the k-th event with all that belongs there."""
        joints = self._inbox.at(k)
        if joints:
            self._log.clear(k, rows)
        for layer, joint in enumerate(joints):
            everyone = rows is ALL and joint.mask is None
            if everyone and self._answers.trusted(joint.channels):  # as usual: nothing to look at
                belief, innovation = self._estimator.update(
                    belief, joint.y, u, event.instant.end, joint.channels
                )
                self._log.put(k, layer, joint.channels, innovation, None, ALL)
                continue
            came, masked = ALL, {}
            if joint.mask is not None:
                came = some(belief, np.any(joint.mask[rows], axis=-1))
                masked = {"mask": joint.mask[within(rows, came)]}
            runs = within(rows, came)
            y = joint.y[runs]
            if not len(y):
                continue
            answer = self._estimator.update(
                take(belief, came), y, u[runs], event.instant.end, joint.channels, **masked
            )
            part, innovation = self._answers.checked(
                answer, joint.channels, len(y), self._width(joint.channels)
            )
            wrong = self._answers.innovation(part, innovation, masked.get("mask"))
            if wrong is not None:
                self._mark(runs, wrong)
            belief = put(belief, came, part)
            self._log.put(k, layer, joint.channels, innovation, masked.get("mask"), runs)
        if self._history is not None:  # a replay writes over what it changes
            self._history.beliefs[k + 1], self._history.controls[k] = belief, u
            self._history.measurements[k + 1] = [
                Measurement(joint.y, u, joint.channels, joint.mask) for joint in joints
            ]
        return belief

    def _width(self, channels: tuple[str, ...]) -> int:
        """Components of a joint measurement."""
        if channels not in self._widths:
            self._widths[channels] = sum(self._inbox.spaces[name].n for name in channels)
        return self._widths[channels]

    def _mark(self, runs: RunIndex, fault: Faults) -> None:
        """Note faults of some rows; the first of a row stays."""
        if self.fault is None:
            self.fault = np.zeros(len(self.late), np.uint8)
        self.fault[runs] = kept(self.fault[runs], fault)

    def _forget(self, tick: int) -> int:
        """Drop what no reading can reach any more; the first event that is left."""
        oldest = tick - self._delays.window
        gone = 0
        while gone < len(self._steps) and self._steps[gone].event.tick < oldest:
            gone += 1
        del self._steps[:gone]
        left = self._count - len(self._steps)
        self._inbox.forget(left)
        return left
