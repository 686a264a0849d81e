"""The instants of a run: a sequence that holds the ticks, and makes an instant when it is asked."""

from array import array
from collections.abc import Iterable, Sequence
from typing import NamedTuple, overload

import numpy as np

from estbench.shapes import Array, Float


class Instant(NamedTuple):
    """The end of one interval of the event loop.

    Attributes:
        start, end: s.
        nstep: physics steps between them.
        channels: names of the channels that are due at `end`.
        control: whether the controller is evaluated at `start`.
        tick: physics steps since t = 0 at `end`.
    """

    start: float
    end: float
    nstep: int
    channels: tuple[str, ...]
    control: bool
    tick: int


class Instants(Sequence[Instant]):
    """Instants that follow each other from t = 0, in ten bytes each.

    Args:
        found: the instants, in order.
        timestep: length of a tick, s.

    Attributes:
        longest: the longest interval, ticks.
    """

    def __init__(self, found: Iterable[Instant], timestep: float):
        self._timestep = timestep
        self._ticks, self._kinds = array("q", [0]), array("H")
        kinds: dict[tuple[tuple[str, ...], bool], int] = {}
        self.longest = 0
        for instant in found:
            self._ticks.append(instant.tick)
            kind = kinds.setdefault((instant.channels, instant.control), len(kinds))
            self._kinds.append(kind)
            self.longest = max(self.longest, instant.nstep)
        self._known = tuple(kinds)

    def __len__(self) -> int:
        return len(self._kinds)

    @overload
    def __getitem__(self, k: int) -> Instant: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[Instant, ...]: ...
    def __getitem__(self, k: int | slice) -> Instant | tuple[Instant, ...]:
        if isinstance(k, slice):
            return tuple(self[i] for i in range(*k.indices(len(self))))
        kind = self._kinds[k]
        k = k + len(self._kinds) if k < 0 else k
        before, tick = self._ticks[k], self._ticks[k + 1]
        channels, control = self._known[kind]
        timestep = self._timestep
        return Instant(before * timestep, tick * timestep, tick - before, channels, control, tick)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def times(self) -> Float[Array, " time"]:
        """The start, and the end of every instant, s."""
        return np.asarray(np.frombuffer(self._ticks, np.int64) * self._timestep, np.float64)

    @property
    def controls(self) -> int:
        """At how many the controller is evaluated."""
        asked = np.array([control for _, control in self._known], bool)
        return int(asked[np.frombuffer(self._kinds, np.uint16)].sum())
