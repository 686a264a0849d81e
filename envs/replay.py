"""Late readings: what a filter bank remembers of its last steps, to go back and replay them.

A reading belongs to the step in which it was taken. When it arrives, the belief of that step is
taken from memory, conditioned on it, and everything since is done again (Bar-Shalom, Li &
Kirubarajan 2001, sec. 6.4).
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from estbench.envs.merge import select
from estbench.shapes import Array, Mask


@dataclass(frozen=True, eq=False)
class Measurement:
    """Readings to be fused together.

    Attributes:
        y: `(row, ny)`; only the components that arrived mean anything.
        channels: their channels.
        arrived: components that arrived `(row, m)`; None is all.
        age: how many steps ago they were taken.
    """

    y: Array
    channels: tuple[str, ...]
    arrived: Mask | None = None
    age: int = 0


class Filter(Protocol):
    """What a replay asks of a filter bank."""

    def predicted(self, belief: Any, u: Array, t: float, dt: float, mask: Mask | None) -> Any:
        """The belief after an interval."""
        ...

    def updated(self, belief: Any, m: Measurement, u: Array, t: float, new: bool) -> Any:
        """The belief given a measurement, whose innovation is noted if it is new."""
        ...


@dataclass(eq=False)
class _Step:
    """One step: the belief before its updates, what led there, and what was done then."""

    prior: Any
    u: Array
    t: float
    dt: float
    mask: Mask | None
    fused: list[Measurement] = field(default_factory=list)
    resets: list[tuple[Mask, Any]] = field(default_factory=list)


class Memory:
    """The last steps of a filter bank.

    Args:
        depth: how many steps back a reading may belong; 0 remembers nothing.
    """

    def __init__(self, depth: int):
        self.depth = depth
        self._steps: deque[_Step] = deque(maxlen=depth + 1)

    def predicted(self, prior: Any, u: Array, t: float, dt: float, mask: Mask | None) -> None:
        """Note the belief at the end of an interval, before its updates."""
        if self.depth:
            self._steps.append(_Step(prior, u, t, dt, mask))

    def reset(self, mask: Mask, fresh: Any) -> None:
        """Note that the rows of a mask have started anew."""
        if mask.all():
            self._steps.clear()
        elif self._steps:
            self._steps[-1].resets.append((mask, fresh))

    def fuse(self, filters: Filter, arrived: Sequence[Measurement]) -> Any:
        """The belief now, given what has arrived; a reading older than the memory is left out."""
        now = len(self._steps) - 1
        known = [m for m in arrived if m.age <= now]
        fresh = {id(m) for m in known}
        for m in known:
            self._steps[now - m.age].fused.append(m)
        first = now - max((m.age for m in known), default=0)
        belief = self._steps[first].prior
        for step in list(self._steps)[first:]:
            if step is not self._steps[first]:
                belief = filters.predicted(belief, step.u, step.t, step.dt, step.mask)
                step.prior = belief
            for m in step.fused:
                belief = filters.updated(belief, m, step.u, step.t + step.dt, id(m) in fresh)
            for mask, started in step.resets:
                belief = select(mask, started, belief)
        return belief
