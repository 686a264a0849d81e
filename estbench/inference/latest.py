"""The innovations of the current step, row by row, for those who look at a filter while it runs."""

from collections.abc import Mapping, Sequence

import numpy as np

from estbench.estimators.protocol import Innovation
from estbench.inference.run_subset import ALL, RunIndex
from estbench.shapes import Array, Bool, Int, Ints, Mask
from estbench.spaces.manifold import Manifold

_Update = tuple[int, Sequence[str], Innovation, Mask | None, RunIndex]


class LatestInnovations:
    """What a step's updates said; of a late reading, what it adds to those of its time.

    NIS of readings that are fused jointly is the sum of their conditional ones: where a late
    reading joins others, the difference of the joint NIS and theirs is its own, with as many
    degrees of freedom as it has components.

    Args:
        spaces: channel -> the manifold of its readings, in the measurement's order.
        rows: how many.
        revised: whether updates may be done again, with more readings.

    Attributes:
        rows: how many.
        innovation: ν of each channel's last reading in this step `(row, m)`, 0 where none came.
        nis: νᵀ S⁻¹ ν of the readings that came in this step `(row,)`.
        dof: how many components came `(row,)`.
    """

    def __init__(self, spaces: Mapping[str, Manifold], rows: int, revised: bool = False):
        stops = np.cumsum([0, *(space.n for space in spaces.values())]).tolist()
        self._slots = {name: slice(a, b) for name, a, b in zip(spaces, stops, stops[1:])}
        self._every = tuple(spaces)
        self.rows, self._width, self._revised = rows, stops[-1], revised
        # Event -> NIS, dof and how often each component was fused, so far and before this step.
        self._fused: dict[int, tuple[Array, Ints, Ints]] = {}
        self._before: dict[int, tuple[Array, Ints, Ints]] = {}
        self._updates: list[_Update] = []
        self.begin()

    def begin(self) -> None:
        """A step begins."""
        self.innovation = np.zeros((self.rows, self._width))
        self.nis, self.dof = np.zeros(self.rows), np.zeros(self.rows, np.int64)

    def clear(self, k: int, rows: RunIndex) -> None:
        """Some rows are updated anew at the k-th event."""
        if not self._revised:
            return
        if k not in self._fused:
            count = np.zeros((self.rows, self._width), np.int64)
            self._fused[k] = np.zeros(self.rows), np.zeros(self.rows, np.int64), count
        nis, dof, count = self._fused[k]
        self._before.setdefault(k, (nis.copy(), dof.copy(), count.copy()))
        nis[rows], dof[rows], count[rows] = 0.0, 0, 0

    def put(
        self,
        k: int,
        layer: int,
        channels: Sequence[str],
        innovation: Innovation,
        mask: Bool[Mask, "run m"] | None,
        rows: RunIndex,
    ) -> None:
        """Some rows were updated; see `Innovations.put`."""
        if not self._revised:
            if rows is ALL:  # half the time
                self.nis += innovation.nis
                self.dof += innovation.dof
            else:
                self.nis[rows] += innovation.nis
                self.dof[rows] += innovation.dof
            residual = innovation.residual
            if mask is None and channels == self._every and len(residual):
                self.innovation[rows] = residual
            else:
                self._show(channels, innovation, mask, rows)
            return
        nis, dof, count = self._fused[k]
        nis[rows] += innovation.nis
        dof[rows] += innovation.dof
        start = 0
        for name in channels:
            slot = self._slots[name]
            width = slot.stop - slot.start
            count[rows, slot] += 1 if mask is None else mask[:, start : start + width]
            start += width
        self._updates.append((k, channels, innovation, mask, rows))

    def settle(self, oldest: int) -> None:
        """The updates of an event are done; before the event `oldest` none is done again."""
        if not self._revised:
            return
        new = {}
        for k, before in self._before.items():
            nis, dof, count = (now - then for now, then in zip(self._fused[k], before))
            more = dof > 0
            self.nis += np.where(more, nis, 0.0)
            self.dof += np.where(more, dof, 0)
            new[k] = more[:, None] & (count > 0)
        for k, channels, innovation, mask, rows in self._updates:
            # What is fused again beside a late reading did not come in this step.
            parts = [new[k][rows, self._slots[name]] for name in channels]
            came = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
            if came.any():
                self._show(channels, innovation, came if mask is None else came & mask, rows)
        self._before.clear()
        self._updates.clear()
        for k in [k for k in self._fused if k < oldest]:
            del self._fused[k]

    def forget(self, rows: Int[Ints, " k"]) -> None:
        """Some rows begin anew."""
        self.innovation[rows], self.nis[rows], self.dof[rows] = 0.0, 0.0, 0

    def _show(
        self, channels: Sequence[str], innovation: Innovation, mask: Mask | None, rows: RunIndex
    ) -> None:
        residual = innovation.residual
        if not np.size(residual):  # an estimator may have none
            return
        start = 0
        for name in channels:
            slot = self._slots[name]
            part = slice(start, start + slot.stop - slot.start)
            value = residual[:, part]
            if mask is not None:
                came = np.broadcast_to(mask, (len(residual), residual.shape[1]))[:, part]
                value = np.where(came, value, self.innovation[rows, slot])
            self.innovation[rows, slot] = value
            start = part.stop
